"""The REST and WebSocket interface under /api/v1. Studio's own pages use nothing else."""
