"""The running gateway: buses and polls, outputs, Modbus bridges, the mailboxes of modems, and the process image."""
