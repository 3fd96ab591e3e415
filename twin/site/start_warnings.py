"""Warnings for the author of a system file about programs whose start waits for a value that they must command first.

A sampling sensor (`sampled:` in its profile) has no measured value before it is given a period. A program that sets the period,
and waits before its first scan for a value of that sensor, never starts. This module only inspects a loaded system file.
"""

from __future__ import annotations

from collections.abc import Mapping

from fieldtwin.gateway.core.files.yaml_file import YamlFile
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.twin.site.schema import PlcForm


def waits_for_its_command(file: YamlFile, plc: PlcForm, devices: Mapping[str, DeviceConfig]) -> tuple[str, ...]:
    """Return one warning for each program that waits for a measured value of a sensor whose period it commands.

    An input that a number replaces (`if_bad: 0`) does not delay a program after the timeout, so it causes no warning.
    """
    found = []
    for name, program in plc.programs.items():
        start = program.start or plc.start
        if start.at_timeout == "start_anyway":
            continue
        commanded = set(program.outputs.values())
        for variable, source in program.inputs.items():
            device, _, tag = source.tag.partition(".")
            if not isinstance(source.if_bad, str) or device not in devices:
                continue
            period = _commanded_by(devices[device], tag, commanded)
            if period:
                error = file.error(
                    ("plc", "programs", name, "inputs", variable),
                    f"program {name} waits for {source.tag} before its first scan, and {device} measures only after "
                    f"this program has written {period}",
                    expected=f"`start: {{timeout_ms: 1000, at_timeout: start_anyway}}` in {name}",
                )
                found.append(str(error))
                break
    return tuple(found)


def _commanded_by(device: DeviceConfig, tag: str, commanded: set[str]) -> str:
    """Return DEVICE.TAG of the period after which `tag` has its first value, if it is `commanded`; "" otherwise."""
    sampled, known = device.profile.sampled, device.profile.tags.get(tag)
    if sampled is None or known is None or known.poll != sampled.poll:
        return ""
    if not known.type.startswith("float"):  # an integer reads 0 before the first sample
        return ""
    period = f"{device.name}.{sampled.period}"
    return period if period in commanded else ""
