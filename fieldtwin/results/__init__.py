"""The results of runs: the events of a trace, and the verdicts of scenarios and checks.

This is the lowest package of the application: it imports no other package of fieldtwin.
"""
