"""The style sheet of the site acceptance document, designed for paper. Colour is never the only sign of a result."""

from __future__ import annotations

STYLE = """
* { box-sizing: border-box; }
body { margin: 0; background: #fff; color: #111; font: 13px/1.45 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif; }
main { max-width: 1000px; margin: 0 auto; padding: 28px 32px 60px; }
h1 { font-size: 26px; margin: 0 0 10px; }
h2 { font-size: 18px; margin: 30px 0 8px; padding-bottom: 3px; border-bottom: 2px solid #111; break-after: avoid; }
h3 { font-size: 15px; margin: 20px 0 4px; break-after: avoid; }
h4 { font-size: 13.5px; margin: 14px 0 4px; break-after: avoid; }
h5 { font-size: 12.5px; margin: 10px 0 3px; font-weight: 600; color: #333; break-after: avoid; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 1px 14px; margin: 6px 0; }
dt { color: #444; } dd { margin: 0; overflow-wrap: anywhere; }
table { border-collapse: collapse; width: 100%; font-size: 12px; margin: 6px 0 10px; }
thead { display: table-header-group; }
th, td { border: 1px solid #999; padding: 3px 6px; text-align: left; vertical-align: top; overflow-wrap: anywhere; }
th { background: #eee; font-weight: 600; overflow-wrap: normal; }
tr { break-inside: avoid; }
.mono { font-family: ui-monospace,"SF Mono",Menlo,Consolas,monospace; font-size: 11px; }
.small { font-size: 11.5px; color: #444; margin: 2px 0; }
.result { border: 2px solid #111; padding: 8px 12px; margin: 12px 0; font-size: 15px; }
.result.good { border-left: 10px solid #1a7f37; } .result.bad { border-left: 10px solid #c1121f; }
.remarks { margin: 8px 0; white-space: pre-wrap; }
.verdict { border: 1px solid #111; padding: 0 8px; border-radius: 9px; font-size: 12.5px; }
.verdict.good { border-color: #1a7f37; } .verdict.bad { border-color: #c1121f; }
.weight { white-space: nowrap; } .part td:first-child { white-space: nowrap; }
.weight.deviation { font-weight: 700; color: #c1121f; } .weight.robustness, .weight.field { color: #8a5a00; }
.weight.waived { color: #444; }
.blank { display: inline-block; width: 90%; border-bottom: 1px solid #111; height: 1.3em; }
.device + .device { border-top: 1px solid #999; padding-top: 2px; margin-top: 14px; }
.deviations td:last-child { white-space: nowrap; font-size: 11px; height: 46px; }
.signatures { break-inside: avoid; }
.boxes { display: flex; gap: 28px; margin-top: 16px; }
.box { flex: 1; } .box .line { height: 60px; border-bottom: 1px solid #111; margin-bottom: 4px; }
@media print {
  body { font-size: 10.5px; } main { max-width: none; padding: 0; } table { font-size: 9.5px; }
  .mono { font-size: 8.5px; } .small { font-size: 9px; } h1 { font-size: 22px; } h2 { font-size: 15px; }
  .deviations td:last-child { font-size: 9px; }
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
}
@page { size: A4; margin: 15mm 14mm 16mm; @bottom-right { content: counter(page) " / " counter(pages); font-size: 9px; } }
"""
