"""The outputs of a run for people and for other programs: JUnit XML, one HTML file, waveforms.

Each writer takes a `Report` (see `model`) and reads nothing else. This package must never depend on how scenarios are
run.
"""
