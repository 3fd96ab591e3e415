"""The commands of `fieldtwin plc`, and the forms in which they show a PLC."""
