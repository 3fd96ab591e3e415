"""The tools that language-model agents use over the Model Context Protocol (`fieldtwin mcp`).

`tools` are functions with checked arguments. They read files below one project folder, run prototypes and scenarios, and read
the plants that the user has enabled. No tool can write to a plant: a write that an agent proposes waits for the user.
`mcp_server` offers the tools over the protocol; nothing else knows it.
"""
