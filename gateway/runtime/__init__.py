"""The running gateway: buses, polls, outputs, the bridge, the mailboxes and the image."""
