"""The mailboxes of a transmitter, connected to the control logic."""
