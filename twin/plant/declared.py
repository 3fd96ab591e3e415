"""The variables that a system file declares: every tag whose value or payload the plant reports, and for each program
whether it runs. These are the variables of the digital model in every twin, and those of a template's ``model.json``.
"""

from __future__ import annotations

from collections.abc import Mapping

from fieldtwin.gateway.core.image.image import TagKind
from fieldtwin.twin.model.variables import Limits, ModelVariable
from fieldtwin.twin.plant.physical import plant_tags
from fieldtwin.twin.site.system import System


def declared_variables(system: System, limits: Mapping[str, Limits] | None = None) -> tuple[ModelVariable, ...]:
    """Return the declared variables, in the system file's order. `limits`, if given, replace those of the profiles.

    A transmitter's inbox is not a variable: it receives commands, which the model processes as commands
    (`DigitalModel.process_event`).
    """
    tags = [
        ModelVariable(tag.name, tag.kind.name.lower(), tag.unit, tag.limits if limits is None else limits.get(tag.name))
        for tag in plant_tags(system).values()
        if not (tag.kind is TagKind.MESSAGE and tag.name.endswith(".inbox"))
    ]
    return (*tags, *(ModelVariable(program, "bool") for program in system.plc.programs))
