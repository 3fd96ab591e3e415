"""The outputs of a run for users and for other programs: one HTML file, coverage, waveforms.

Each writer takes a `Report` (see `fieldtwin.results.model`) and reads nothing else. This package must never depend on how
scenarios are run.
"""
