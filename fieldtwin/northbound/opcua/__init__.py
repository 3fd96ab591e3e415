"""The OPC UA server of a run (`serve` of kind `opcua`, extra `opcua`)."""
