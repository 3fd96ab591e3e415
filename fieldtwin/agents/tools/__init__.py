"""The tools of an agent, by what they are about."""
