"""A debugger for Structured Text over the Debug Adapter Protocol, which editors such as VS Code speak."""
