"""Build a CANopen node from a profile: data sheet, model, recording and journal.

This module must not depend on buses or clocks: recorded signals have their own start time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from fieldtwin.emulators.canopen.behaviour import DeviceModel
from fieldtwin.emulators.canopen.eds.codec import encode
from fieldtwin.emulators.canopen.eds.dictionary import Dictionary, Key, load_eds
from fieldtwin.emulators.canopen.eds.remarks import Remark, remarks
from fieldtwin.emulators.canopen.node import CanopenNode, NodeContext
from fieldtwin.emulators.distortion import Distortions
from fieldtwin.emulators.journal import DeviceValueLog
from fieldtwin.emulators.models.canopen.by_profile import NO_MODEL, model_for
from fieldtwin.emulators.models.canopen.distorted_objects import DistortedObjects
from fieldtwin.emulators.models.canopen.played_objects import HeldObjects, PlayedObjects
from fieldtwin.emulators.models.drive.drive import Drive
from fieldtwin.emulators.models.drive.objects import missing_modes
from fieldtwin.emulators.replay.can_log import CanLog
from fieldtwin.emulators.replay.objects import recorded_objects
from fieldtwin.emulators.signals import Signals
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile


@dataclass(frozen=True, slots=True)
class NodeOptions:
    """Settings of a node that the user may give in addition to its files.

    `model` is a number of `by_profile.MODELS` as text, or `NO_MODEL`; with None, object 1000h decides. Without
    `parameter_values` the node starts with the DefaultValues of its data sheet.
    """

    model: str | None = None
    parameter_values: bool = True


@dataclass(frozen=True, slots=True)
class EmulatedNode:
    """The node, and the journal of its object values by tag.

    `distortions` are the value faults of its objects. `remarks` list settings that do not fit the node.
    """

    node: CanopenNode
    journal: DeviceValueLog
    distortions: Distortions
    remarks: Sequence[Remark] = ()


def emulated_node(
    profile: DeviceProfile,
    node_id: int,
    recording: Signals | CanLog | None,
    now_ns: int,
    identity: Mapping[str, str] | None = None,
    options: NodeOptions | None = None,
) -> EmulatedNode:
    """Return the node of a CANopen profile. It plays recorded signals, or a log of the bus on which the node was recorded.

    Without a `recording` it holds the values of the data sheet and those of its model. `identity` maps tags to values that
    replace those of the data sheet for this device. Raises `FileInvalid` for a data sheet or log that cannot be read and for a
    tag whose object the data sheet lacks, and `UsageError` for an identity that is not a number and for a log without this node.
    """
    if profile.eds_path is None:
        raise UsageError("a node needs a data sheet", where=profile.path, expected="`eds: FILE.eds` in the profile")
    options = options or NodeOptions()
    dictionary = load_eds(profile.eds_path, parameter_values=options.parameter_values)
    tags = profile.tags.values()
    held = HeldObjects(tags)
    own = _factory(profile, dictionary, identity or {})
    model = model_for(dictionary, options.model)
    context = NodeContext(model=model, held=held, factory=own)
    if recording is not None and not isinstance(recording, CanLog):
        played = PlayedObjects(tags, dictionary, recording)
        unfed = [
            tag for tag in tags if tag.name not in recording.names
        ]  # the faults of the other tags are applied when their recorded values are set
        distorted = DistortedObjects(unfed, dictionary, played, has_model=model is not None, named=True)
        distorted.share(played.distortions, played.names)
    else:
        objects = None if recording is None else recorded_objects(recording, dictionary, node_id)
        if objects is not None:
            context = replace(context, factory={**objects.initial, **own}, refusals=objects.refusals)
        distorted = DistortedObjects(tags, dictionary, objects, has_model=model is not None)
    over = distorted.over if model is not None else None
    context = replace(context, source=distorted, distort=over, given=distorted.given)
    node = CanopenNode(dictionary, node_id, context)
    distorted.data = node.data
    for tag in tags:  # values of the data sheet, for tags that no source provides, are journalled too
        if tag.object is not None and node.data.has(*tag.object):
            held({tag.object: node.data.get(*tag.object)}, now_ns)
    return EmulatedNode(node, held.journal, distorted.distortions, node_remarks(dictionary, node_id, model, options))


def node_remarks(dictionary: Dictionary, node_id: int, model: DeviceModel | None, options: NodeOptions) -> list[Remark]:
    """Return the settings that do not fit this node.

    A model that the user chose to leave out is not reported as missing.
    """
    found = remarks(dictionary, node_id, has_model=model is not None or options.model == NO_MODEL)
    if isinstance(model, Drive) and (missing := missing_modes(dictionary)):
        listed = ", ".join(map(str, missing))
        found.append(
            Remark(
                f"6502h (supported drive modes) names modes that the drive model lacks: {listed}; it reads without them"
            )
        )
    return found


def _factory(profile: DeviceProfile, dictionary: Dictionary, identity: Mapping[str, str]) -> dict[Key, bytes]:
    factory: dict[Key, bytes] = {}
    for name, text in identity.items():
        key = profile.tags[name].object
        entry = dictionary.entry(*key) if key else None
        if key is None or entry is None:
            raise FileInvalid(f"the EDS has no object for tag {name!r}", path=dictionary.path)
        try:
            factory[key] = encode(entry.data_type, int(text, 0))
        except ValueError:
            raise UsageError(
                f"identity {name!r}", where=profile.name, expected="a number that fits", got=text
            ) from None
    return factory
