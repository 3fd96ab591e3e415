"""The mailboxes (inbox and outbox registers) of a transmitter, such as an acoustic modem, and their use by the control logic."""
