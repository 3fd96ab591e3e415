"""Everything that runs a system: processes, live runs, virtual time, scenario targets, campaigns, shadows and what-if."""
