"""Generate the page of Studio's operations from the OpenAPI description that the server returns."""

from __future__ import annotations

from fieldtwin.studio.api.openapi import describe
from fieldtwin.studio.app import OPERATIONS


def studio_page() -> str:
    """Return the table of all operations: method, path, summary, and the role that may use it."""
    rows = [
        f"| `{method.upper()} {path}` | {about['summary']} | {'operate' if 'description' in about else 'view'} |"
        for path, methods in describe(OPERATIONS, "fieldtwin Studio")["paths"].items()
        for method, about in methods.items()
    ]
    lines = [
        "# Operations of Studio's interface",
        "",
        "[Studio's interface](studio-api.md) describes tokens, errors and updates.",
        "",
        "| operation | purpose | role |",
        "|---|---|---|",
        *rows,
    ]
    return "\n".join(lines) + "\n"
