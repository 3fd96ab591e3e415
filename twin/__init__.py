"""Systems that combine gateway, PLC and emulators: system files, plants, prototypes, digital models and digital threads."""
