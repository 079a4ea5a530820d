"""Models that the recordings of the reference are made with."""

from __future__ import annotations

from compensator.model.model_file import parse_model, read_model_bytes

QUILL = read_model_bytes("quill").decode()

EFFECTS = """
[[effect]]
kind = "input"
channel = "coolant_degc"
curve = "linear"
tau_min = [7.0, 90.0]
gain = [0.4, -0.2]
delay_min = 4.5
[[effect]]
kind = "input"
channel = "spindle_rpm"
curve = "square"
tau_min = [30.0]
gain = [1e-7]
delay_min = 0.0
[[effect]]
kind = "input"
channel = "fan_rpm"
curve = "abs"
tau_min = [0.0]
gain = [5e-4]
delay_min = 2.0
[[effect]]
kind = "input"
channel = "spindle_rpm"
curve = "power 5/3"
tau_min = [12.0]
gain = [1e-6]
delay_min = 0.25
[[effect]]
kind = "gain"
path = "TDTF"
change = 0.2
[[effect]]
kind = "gain"
path = "DTF"
change = -0.05
[[effect]]
kind = "dynamics"
form = "missing"
path = "DTF"
tau_min = 40.0
gain = 0.05
[[effect]]
kind = "dynamics"
form = "mistimed"
path = "DTF"
tau_min = 25.0
instead_of_min = 20.9
[[effect]]
kind = "dynamics"
form = "changed"
path = "DTF"
tau_min = [3.0, 30.0, 200.0]
gain = [0.01, -0.02, 0.03]
gain_ambient = [0.1, -0.3, 0.2]
[[effect]]
kind = "delay"
path = "DTF"
delay_min = 3.5
lag_min = 2.0
[[effect]]
kind = "delay"
path = "TDTF"
delay_min = 6.0
lag_min = 0.0
[[effect]]
kind = "nonlinear"
form = "square"
path = "DTF"
change = 0.02
[[effect]]
kind = "nonlinear"
form = "odd square"
path = "TDTF"
change = 0.1
[[effect]]
kind = "nonlinear"
form = "cube"
path = "DTF"
change = -0.02
[[effect]]
kind = "nonlinear"
form = "drive"
path = "DTF"
change = 0.1
b = [0.0, 0.1]
a = [1.0, -0.9]
[[effect]]
kind = "scheduled"
form = "share"
origin = "start"
path = "DTF"
channel = "coolant_degc"
change = 0.1
span = 2.0
[[effect]]
kind = "scheduled"
form = "drive"
origin = "zero"
path = "DTF"
channel = "spindle_rpm"
change = 0.1
span = 2000.0
b = [0.0, 0.1]
a = [1.0, -0.9]
[[effect]]
kind = "scheduled"
form = "speed"
origin = "zero"
path = "TDTF"
channel = "spindle_rpm"
change = 0.1
span = 2000.0
tau_min = 12.0
[[effect]]
kind = "scheduled"
form = "row"
origin = "zero"
path = "DTF"
channel = "fan_rpm"
span = 3000.0
tau_min = [4.0, 50.0]
gain = [0.01, 0.02]
gain_share = [0.02, -0.01]
[[effect]]
kind = "hysteresis"
form = "play"
path = "DTF"
half_width_um = 0.7
[[effect]]
kind = "hysteresis"
form = "stick"
path = "all"
half_width_um = 1.5
"""


def changed(name: str, *pairs: tuple[str, str], also: str = "") -> bytes:
    """Return the published model with some texts in the place of others, under a name of its own."""
    text = QUILL
    for old, new in (('name = "quill"', f'name = "{name}"'), *pairs):
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    data = (text + also).encode()
    parse_model(data, source=name)
    return data


def direct(name: str, method: str, inputs: str) -> bytes:
    """Return a model from T_Q - AT straight to the deformation."""
    data = f"""schema = 1
name = "{name}"
kind = "direct"
sample_period_s = 60.0
inputs = "{inputs}"
[paths.DTF]
unit = "um/K"
form = "continuous"
numerator = [4.0, 20.0]
denominator = [1.0, 120.0]
[paths.TDTF]
unit = "um/K"
form = "sampled"
b = [0.0, 0.05]
a = [1.0, -0.95]
[estimator]
method = "{method}"
t_q_noise_std_k = 0.05
at_noise_std_k = 0.05
at_walk_std_k = 0.1
difference_walk_std_k = 0.5
[validity]
t_q_degc = [10.0, 60.0]
at_degc = [12.0, 32.0]
[uncertainty]
y_std_um = 1.0
""".encode()
    parse_model(data, source=name)
    return data


MODELS = {
    "quill.toml": QUILL.encode(),
    "stronger.toml": changed("stronger", ("[0.0001065, ", "[0.0001278, ")),
    "effects.toml": changed("effects", also=EFFECTS),
    "inverse.toml": changed("inverse", ('method = "kalman"', 'method = "inverse"')),
    "slow.toml": changed("slow", ("sample_period_s = 60.0", "sample_period_s = 300.0")),
    "direct.toml": direct("direct", "kalman", "changes"),
    "direct-inverse.toml": direct("direct-inverse", "inverse", "absolute"),
}
