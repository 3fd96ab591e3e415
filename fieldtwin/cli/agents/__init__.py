"""Commands for language-model agents: the server of their tools, and the decision about the writes that they propose."""
