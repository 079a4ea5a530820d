"""The example of several axes in the description of the configuration is one."""

from __future__ import annotations

import re

from compensator.config import parse_config
from compensator.service.axes import planned_outputs
from tests.audit.made import CONFIG
from tests.deploy.conftest import ROOT

LIMITS = b"offset_max_um = 200.0\noffset_rate_max_um_per_min = 8.0\n"


def test_the_example_of_several_axes_is_a_configuration() -> None:
    text = (ROOT / "deploy/CONFIGURATION.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"^```toml\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert LIMITS in CONFIG
    config = parse_config(CONFIG.replace(LIMITS, b"") + example.encode(), source="example")
    assert config.axis is not None
    assert config.axis.names() == ("y", "z", "a")
    assert config.limits.offset_max_um == 120.0
    assert {one.name: one.output.weights for one in planned_outputs(config.axis)} == {
        "y_slope": (("y_slope", 1.0),),
        "z": (("z", 1.0),),
        "a": (("ch2", 5.0), ("ch1", -5.0)),
    }
