"""Commands for the files of a system, for this computer, and for reports."""
