"""HTML reports of runs, with links to the views of their traces.

A report is a file that the user may have from elsewhere, so it has a separate content security policy: its styles are used, and
its scripts are not executed. Only files that `fieldtwin test` has written are served.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from html import escape, unescape
from pathlib import Path
from urllib.parse import quote

from starlette.responses import Response

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.input_file import read_input

POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
MOST_BYTES = 64 << 20
_GENERATOR = b'<meta name="generator" content="fieldtwin">'
_BEGIN_BYTES = 1000
"""Number of bytes at the beginning of a report that must contain the tag that names fieldtwin as the generator."""
_INSTANT = re.compile(r'<pre class="instant" data-trace="([^"]*)" data-at="([0-9.]*)">.*?</pre>', re.DOTALL)


def report_response(path: Path, traces: Mapping[str, str]) -> Response:
    """Return a report as a page. `traces`: the name of each trace in Studio, by the name of its file.

    Raises `FileInvalid` if the file is missing, too long, or not a report.
    """
    try:
        content = read_input(path, MOST_BYTES)
    except OSError as e:
        raise FileInvalid(f"cannot read the report: {e.strerror or e}", path=str(path)) from e
    if _GENERATOR not in content[:_BEGIN_BYTES]:
        raise FileInvalid(
            "not a report of fieldtwin", path=str(path), expected="a file that `fieldtwin test --html` has written"
        )

    def link(found: re.Match[str]) -> str:
        name = traces.get(Path(unescape(found[1])).name)
        if name is None:
            return found[0]
        at = f"?t={found[2]}" if found[2] else ""
        return f'<p><a href="/#/{escape(quote(f"trace:{name}", safe=""))}/overview{at}">Show the trace at this instant</a></p>'

    return page_response(_INSTANT.sub(link, content.decode("utf-8", "replace")))


def page_response(page: str) -> Response:
    """Return the text of a report as a page, with its content security policy."""
    return Response(page, media_type="text/html; charset=utf-8", headers={"Content-Security-Policy": POLICY})
