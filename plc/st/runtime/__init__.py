"""What compiled Structured Text uses while it runs, other than the arithmetic of `fieldtwin.plc.st.values`."""
