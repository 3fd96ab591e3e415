"""The version of fieldtwin. Other tools read this file without importing the package."""

__version__ = "0.1.0"
