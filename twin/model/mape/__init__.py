"""The loop of a digital twin: monitor, analyze, plan, execute."""
