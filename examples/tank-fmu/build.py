"""Build tank.fmu from tank.c: ``python build.py [--fmi 3] [-o FILE]``. It needs gcc, and FMI's headers in the package fmpy."""

from __future__ import annotations

import argparse
import re
import subprocess
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

import fmpy

HERE = Path(__file__).resolve().parent
HEADERS = Path(fmpy.__file__).parent / "c-code"
TOKEN = "{8c4e810f-3df3-4a00-8276-176fa3c9f9e0}"
VARIABLES = [  # in the order of their value references in tank.c, which begin with 1: name, type, causality, start, unit
    ("pump", "Boolean", "input", "false", ""),
    ("inflow", "Real", "input", "0", "m3/s"),
    ("level", "Real", "output", "1.2", "m"),
    ("outflow", "Real", "output", "", "m3/s"),
    ("full", "Boolean", "output", "", ""),
    ("area", "Real", "parameter", "0.5", "m2"),
    ("pump_flow", "Real", "parameter", "0.08", "m3/s"),
    ("outlet.k", "Real", "parameter", "0.03", ""),
]


def description(fmi: int) -> str:
    """Return the modelDescription.xml of FMI 2.0 or 3.0."""
    variables, outputs, calculated = [], [], []
    for number, (name, kind, causality, start, unit) in enumerate(VARIABLES, 1):
        variability = "fixed" if causality == "parameter" else "discrete" if kind == "Boolean" else "continuous"
        initial = "" if causality == "input" else f' initial="{"exact" if start else "calculated"}"'
        common = f'name="{name}" valueReference="{number}" causality="{causality}" variability="{variability}"{initial}'
        typed = (f' start="{start}"' if start else "") + (f' unit="{unit}"' if unit else "")
        if fmi == 2:
            variables.append(f"<ScalarVariable {common}><{kind}{typed}/></ScalarVariable>")
        else:
            variables.append(f"<{'Float64' if kind == 'Real' else kind} {common}{typed}/>")
        if causality == "output":
            unknown = f'index="{number}"' if fmi == 2 else f'valueReference="{number}"'
            outputs.append(f"<{'Unknown' if fmi == 2 else 'Output'} {unknown}/>")
            calculated += [] if start else [f"<{'Unknown' if fmi == 2 else 'InitialUnknown'} {unknown}/>"]
    units = [f'<Unit name="{unit}"/>' for unit in sorted({variable[4] for variable in VARIABLES} - {""})]
    if fmi == 2:
        outputs = ["<Outputs>", *outputs, "</Outputs>"]
        calculated = ["<InitialUnknowns>", *calculated, "</InitialUnknowns>"]
    else:
        variables.insert(
            0, '<Float64 name="time" valueReference="0" causality="independent" variability="continuous"/>'
        )
    token = "guid" if fmi == 2 else "instantiationToken"
    return "\n".join(
        [
            '<?xml version="1.0" encoding="UTF-8"?>',
            f'<fmiModelDescription fmiVersion="{fmi}.0" modelName="tank" {token}="{TOKEN}">',
            '<CoSimulation modelIdentifier="tank" canHandleVariableCommunicationStepSize="true"/>',
            *("<UnitDefinitions>", *units, "</UnitDefinitions>"),
            *("<ModelVariables>", *variables, "</ModelVariables>"),
            *("<ModelStructure>", *outputs, *calculated, "</ModelStructure>"),
            "</fmiModelDescription>",
        ]
    )


def unused(fmi: int, source: str) -> str:
    """Return C code with the functions of the standard that `source` does not define: each returns fmiError."""
    header = (HEADERS / f"fmi{fmi}Functions.h").read_text(encoding="utf-8")
    names = re.findall(rf"FMI{fmi}_Export fmi{fmi}\w+TYPE\s+(fmi{fmi}\w+);", header)
    return "\n".join(f"int {name}(void) {{ return 3; }}" for name in names if f"{name}(" not in source) + "\n"


def build(out: Path, fmi: int = 2, flags: Sequence[str] = ()) -> None:
    """Compile tank.c with gcc and pack it. `flags` are further arguments for gcc."""
    platform = fmpy.platform if fmi == 2 else fmpy.platform_tuple
    with tempfile.TemporaryDirectory() as folder:
        stubs = Path(folder, "unused.c")
        stubs.write_text(unused(fmi, (HERE / "tank.c").read_text(encoding="utf-8")), encoding="utf-8")
        library = Path(folder, "tank.so")
        command = ["gcc", "-O2", "-shared", "-fPIC", f"-DFMI={fmi}", f'-DTOKEN="{TOKEN}"', f"-I{HEADERS}", *flags]
        subprocess.run([*command, str(HERE / "tank.c"), str(stubs), "-o", str(library), "-lm"], check=True)
        with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("modelDescription.xml", description(fmi))
            archive.write(library, f"binaries/{platform}/tank.so")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Build tank.fmu from tank.c.")
    parser.add_argument("--fmi", type=int, choices=(2, 3), default=2, help="the version of FMI")
    parser.add_argument("-o", "--out", type=Path, default=HERE / "tank.fmu", help="the FMU to write")
    said = parser.parse_args()
    build(said.out, said.fmi)
    print(f"{said.out}: FMI {said.fmi}.0, co-simulation")
