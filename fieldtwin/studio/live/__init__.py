"""Observe running instances: their statuses, the history of their values and the frames of their buses. No HTTP here."""
