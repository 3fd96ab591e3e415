"""What a run leaves for people and for other programs: JUnit XML, one HTML file, waveforms.

Takes a `Report` (see `model`), reads nothing else, and must never know how scenarios are run.
"""
