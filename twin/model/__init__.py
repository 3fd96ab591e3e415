"""The digital model, the digital shadow and the digital twin that are built on it, and the Monitor-Analyze-Plan-Execute loop."""
