"""The pages of the book that reports and messages name, and their URLs.

The book is not published before the first release. For that release set `PUBLISHED_AT`. Until then an organization that
builds the book itself names its place in ``FIELDTWIN_BOOK``, such as ``https://docs.example.org/fieldtwin``.
"""

from __future__ import annotations

import os
import re

PUBLISHED_AT = ""
"""The URL of the published book, without a slash at the end."""
VARIABLE = "FIELDTWIN_BOOK"

_ROW = re.compile(r"([A-Z]{2}-\d{3})[a-h]?")


def base_url() -> str:
    """Return the URL of the book without a slash at the end, or "" if the installation does not have one."""
    return (os.environ.get(VARIABLE) or PUBLISHED_AT).rstrip("/")


def case_page(id: str) -> str:
    """Return the page of a test case with its anchor, as ``reference/cases/mb-015.html#mb-015a``; "" for other IDs."""
    row = _ROW.fullmatch(id)
    return f"reference/cases/{row[1].lower()}.html#{id.lower()}" if row else ""


def case_url(id: str) -> str:
    """Return the URL of the page of a test case, or "" if the book has no URL."""
    page = case_page(id)
    return f"{base_url()}/{page}" if page and base_url() else ""
