"""The explanation that `why` gives for a value: every quality and reason has one, and a good value needs none."""

from __future__ import annotations

import pytest

from fieldtwin.agents.tools.instances import explanation
from fieldtwin.gateway.core.values import Quality, Reason


def test_a_good_value_needs_no_explanation() -> None:
    assert explanation(str(Quality.GOOD), str(Reason.NONE)) == []


@pytest.mark.parametrize("quality", [quality for quality in Quality if quality is not Quality.GOOD])
@pytest.mark.parametrize("reason", list(Reason))
def test_every_quality_and_reason_is_explained(quality: Quality, reason: Reason) -> None:
    found = explanation(str(quality), str(reason))
    assert len(found) >= (1 if reason is Reason.NONE else 2)
    assert all(entry["meaning"] and entry["what_to_do"] for entry in found)
