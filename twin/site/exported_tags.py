"""The `metrics` section of a system file, resolved: the tags whose values a run exports to Prometheus.

Every error is reported with file, line and column: unknown tags, tags without a number, patterns that match no tag, and more tags
than `MOST_TAGS`. This module does not know the format of metrics.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase

from fieldtwin.gateway.core.files.error_collector import ErrorCollector, FollowingError
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.twin.site.references import no_device
from fieldtwin.twin.site.schema import MetricsForm

MOST_TAGS = 1000
"""The largest number of exported tags. Each has two time series, or three while it is not good, and Prometheus keeps every
series in memory.
"""


@dataclass(frozen=True, slots=True)
class ExportedTag:
    """A tag whose value is exported. `unit` is the unit in the device's profile, "" if it states none."""

    device: str
    tag: str
    unit: str

    @property
    def name(self) -> str:
        """Return DEVICE.TAG."""
        return f"{self.device}.{self.tag}"


def resolve_exported_tags(
    file: YamlFile, form: MetricsForm | None, devices: Mapping[str, DeviceConfig], errors: ErrorCollector
) -> tuple[ExportedTag, ...]:
    """Return the tags that the patterns of `metrics: {tags: [...]}` match, each once, in the order of patterns and devices.

    Errors are added to `errors`; the result contains the tags of the patterns without error.
    """
    found: dict[str, ExportedTag] = {}
    for i, pattern in enumerate(form.tags if form is not None else []):
        loc: tuple[Key, ...] = ("metrics", "tags", i)
        with errors.collect():
            matched = (
                _matches(file, loc, pattern, devices) if _is_wild(pattern) else [_named(file, loc, pattern, devices)]
            )
            total = len(found.keys() | {tag.name for tag in matched})
            if total > MOST_TAGS:
                raise file.error(
                    loc,
                    f"up to this pattern, the patterns match {total:,} tags",
                    expected=f"at most {MOST_TAGS:,} tags, because each has two time series",
                    hint="name the tags that a dashboard or an alert needs",
                )
            found |= {tag.name: tag for tag in matched}
    return tuple(found.values())


def _is_wild(pattern: str) -> bool:
    return "*" in pattern or "?" in pattern


def _named(file: YamlFile, loc: tuple[Key, ...], name: str, devices: Mapping[str, DeviceConfig]) -> ExportedTag:
    """Return the tag with this name. A tag that cannot be exported is an error here, because the user named it."""
    device_name, _, local = name.partition(".")
    device = devices.get(device_name)
    if device is None:
        raise no_device(file, loc, device_name)
    known = device.profile.tags
    if local not in known:
        raise file.error(
            loc, f"{device_name!r} has no tag {local!r}", expected=", ".join(known), hint=did_you_mean(local, known)
        )
    if trouble := _trouble(known[local]):
        raise file.error(loc, f"{name!r} {trouble}", expected="a readable tag with a number that is not secret")
    return _exported(device, known[local])


def _matches(
    file: YamlFile, loc: tuple[Key, ...], pattern: str, devices: Mapping[str, DeviceConfig]
) -> list[ExportedTag]:
    """Return the tags that match the pattern and can be exported. Raises `FileInvalid` if no tag does."""
    matched = [
        (device, tag)
        for device in devices.values()
        for tag in device.profile.tags.values()
        if fnmatchcase(f"{device.name}.{tag.name}", pattern)
    ]
    usable = [_exported(device, tag) for device, tag in matched if not _trouble(tag)]
    if usable:
        return usable
    if len(devices) < len(file.section("devices")):
        raise FollowingError(f"{pattern!r} may match tags of a device that has an error", path=file.path)
    if matched:
        device, tag = matched[0]
        raise file.error(
            loc,
            f"{pattern!r} matches no tag that can be exported: {device.name}.{tag.name} {_trouble(tag)}",
            expected="a pattern that matches a readable tag with a number that is not secret",
        )
    raise file.error(
        loc,
        f"{pattern!r} matches no tag",
        expected="DEVICE.TAG, where * stands for any text and ? for one character",
        hint=did_you_mean(pattern, (f"{d.name}.{t}" for d in devices.values() for t in d.profile.tags)),
    )


def _trouble(tag: Tag) -> str:
    """Return why the tag cannot be exported, "" if it can."""
    if tag.secret:
        return "is secret, and everyone who reaches the port can read metrics"
    if tag.is_text:
        return "is text, and a metric is a number"
    return "" if tag.readable else "cannot be read"


def _exported(device: DeviceConfig, tag: Tag) -> ExportedTag:
    return ExportedTag(device.name, tag.name, tag.unit)
