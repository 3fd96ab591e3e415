"""A simulation tool: connect the tank (tank.fmu) with its PLC (plc.fmu), both as FMUs, and step them together with FMPy."""

from __future__ import annotations

import shutil
from typing import Any

from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Slave

STEP_S = 0.1
END_S = 60.0


class Instance:
    """An FMU from 0 s on, with variables by name."""

    def __init__(self, path: str, **start: float) -> None:
        said = read_model_description(path)
        self._folder = extract(path)
        self._reference = {variable.name: variable.valueReference for variable in said.modelVariables}
        self._fmu: Any = FMU2Slave(
            guid=said.guid,
            unzipDirectory=self._folder,
            modelIdentifier=said.coSimulation.modelIdentifier,
            instanceName=path,
        )
        self._fmu.instantiate(loggingOn=True)
        for name, value in start.items():
            self._fmu.setReal([self._reference[name]], [value])
        self._fmu.setupExperiment(startTime=0.0)
        self._fmu.enterInitializationMode()
        self._fmu.exitInitializationMode()
        self.step = self._fmu.doStep

    def real(self, name: str) -> float:
        [value] = self._fmu.getReal([self._reference[name]])
        return float(value)

    def flag(self, name: str) -> bool:
        [value] = self._fmu.getBoolean([self._reference[name]])
        return bool(value)

    def set_real(self, name: str, value: float) -> None:
        self._fmu.setReal([self._reference[name]], [value])

    def set_flag(self, name: str, value: bool) -> None:
        self._fmu.setBoolean([self._reference[name]], [value])

    def end(self) -> None:
        self._fmu.terminate()
        self._fmu.freeInstance()
        shutil.rmtree(self._folder)


def main() -> None:
    """Print each change of the pump with the level of the water."""
    water = Instance("tank.fmu", level=1.5, area=0.8)
    plc = Instance("plc.fmu")
    runs = False
    for number in range(round(END_S / STEP_S)):
        t_s = number * STEP_S
        plc.set_real("set.sensor.level", water.real("level"))
        water.set_flag("pump", runs)
        water.step(t_s, STEP_S)
        plc.step(t_s, STEP_S)
        if runs != plc.flag("pump.run"):
            runs = not runs
            print(f"{t_s + STEP_S:5.1f} s: level {water.real('level'):.2f} m, pump {'on' if runs else 'off'}")
    plc.end()
    water.end()


if __name__ == "__main__":
    main()
