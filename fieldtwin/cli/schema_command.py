"""`fieldtwin schema`: the JSON schema of a kind of file, for editors and checks."""

from __future__ import annotations

import json
import sys

import click
from pydantic import BaseModel

from gateway.core.profile_schema import ProfileForm
from twin.system_schema import PrototypeForm, SystemForm

FORMS: dict[str, type[BaseModel]] = {"system": SystemForm, "prototype": PrototypeForm, "profile": ProfileForm}


@click.command("schema")
@click.argument("kind", type=click.Choice(list(FORMS)))
def command(kind: str) -> int:
    """Print the JSON schema of a system, prototype or profile file."""
    json.dump(FORMS[kind].model_json_schema(), sys.stdout, indent=2)
    sys.stdout.write("\n")
    return 0
