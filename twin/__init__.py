"""Where gateway, PLC and emulators meet: system files, plants, prototypes, digital models and digital threads."""
