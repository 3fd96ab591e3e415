"""The process image: the data that gateway and PLC share."""
