"""Located variables, and the tasks and programs of configurations."""
