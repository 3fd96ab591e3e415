"""The services of a compose file that run fieldtwin, and the check of what they refer to."""
