"""Write the results of a test run, as the pytest plugin sends them, as one HTML page with a requirement matrix."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.reports.run.html import write_html
from fieldtwin.results.model import CheckResult, Report, ScenarioResult, Verdict

_VERDICTS = {verdict.value: verdict for verdict in Verdict}


def write_report(args: dict[str, Any]) -> None:
    """Write the HTML page ``args["file"]`` from the data of a test run.

    The data are ``tests`` (name, verdict, requirements, why, text, took_s, reproduce, file, line, case, role, impact),
    ``title``, ``reproduce``, ``versions``. Raises `UsageError` for an unknown verdict.
    """
    results = []
    for test in args.get("tests") or ():
        verdict = _VERDICTS.get(str(test.get("verdict")))
        if verdict is None:
            raise UsageError("a verdict", expected=", ".join(_VERDICTS), got=repr(test.get("verdict")))
        text = str(test.get("text") or "")
        why = str(test.get("why") or (text.splitlines() or [""])[-1])
        checks = [CheckResult("1", why, verdict, got=text if text.strip() != why else "")] if text else []
        results.append(
            ScenarioResult(
                str(test.get("name")),
                verdict,
                checks if verdict is not Verdict.PASSED else (),
                tuple(map(str, test.get("requirements") or ())),
                file=str(test.get("file") or ""),
                line=int(test.get("line") or 0),
                reason=text if verdict is Verdict.SKIPPED else why,
                reproduce=str(test.get("reproduce") or ""),
                took_s=float(test.get("took_s") or 0.0),
                case=str(test.get("case") or ""),
                role=str(test.get("role") or ""),
                impact=str(test.get("impact") or ""),
            )
        )
    versions = {str(k): str(v) for k, v in dict(args.get("versions") or {}).items()}
    report = Report(
        str(args.get("title") or "tests"), results, reproduce=str(args.get("reproduce") or ""), versions=versions
    )
    write_html(report, Path(str(args["file"])))
