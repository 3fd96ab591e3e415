"""The rules of WCAG 2 (levels A and AA) on the page that the browser shows, checked by axe-core.

axe-core is fetched by ``scripts/studio-assets --tests``. It is evaluated through the browser's debugger, which the page's Content
Security Policy does not restrict, so the policy stays as users have it.
"""

from __future__ import annotations

from pathlib import Path

from browser import Window

AXE = Path(__file__).parents[3] / "build" / "axe-core" / "axe.min.js"
MISSING = "" if AXE.is_file() else "needs axe-core, which scripts/studio-assets --tests fetches with npm"
_RUN = """
const [tags, done] = arguments;
axe.run(document, {runOnly: {type: "tag", values: tags}, resultTypes: ["violations"]}).then(
  ({violations}) => done(violations.flatMap(({id, nodes}) =>
    nodes.map(node => `${id}: ${node.html.slice(0, 200)} ${node.failureSummary.split("\\n").slice(1).join(" ")}`))),
  error => done([`axe-core failed: ${error}`]),
);
"""
TAGS = ("wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa")


def violations(window: Window) -> list[str]:
    """Return each violation on the present page: the rule, the element, and what is wrong with it."""
    window.driver.execute_cdp_cmd("Runtime.evaluate", {"expression": AXE.read_text(encoding="utf-8")})
    found: list[str] = window.driver.execute_async_script(_RUN, TAGS)
    return found
