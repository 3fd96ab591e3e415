"""The gateway's buses: connections, polls, queues and writes."""
