"""The digital model, the shadow and the twin that are built on it, and the Monitor-Analyze-Plan-Execute loop."""
