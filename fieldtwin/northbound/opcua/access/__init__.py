"""Which clients and users an OPC UA server admits: certificates, passwords, roles, and the checks of channels and sessions."""
