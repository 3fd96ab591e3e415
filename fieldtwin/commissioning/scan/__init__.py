"""Find the devices on a bus, and the causes of a silent bus. The commands listen before they send."""
