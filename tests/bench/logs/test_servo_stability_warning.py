"""Test of the warning about servos whose gains are too large for the time step."""

import numpy as np
import pytest

from bench.cli.main import main
from bench.logs.quality.log_quality import check_recording_plausible
from bench.logs.recording_loading import load_recording

ARM = """<mujoco><option timestep="0.002" integrator="{integrator}" gravity="0 0 0"/>
<worldbody><body name="arm"><joint name="wrist" axis="0 0 1"/><geom size="0.1" mass="0"/>
<inertial pos="0 0 0" mass="1" diaginertia="1 1 0.01"/></body></worldbody>
<actuator><position name="servo" joint="wrist" kp="100" kv="{kv}" forcerange="-5 5"/></actuator>
</mujoco>"""

DESCRIPTION = """model = "arm.xml"
[channels."q.wrist"]
unit = "rad"
[inputs."u.servo"]
unit = "rad"
"""


def write_recording(folder, integrator, kv):
    text = ARM.format(integrator=integrator, kv=kv)
    (folder / "arm.xml").write_text(text, encoding="utf-8")
    (folder / "log.toml").write_text(DESCRIPTION, encoding="utf-8")
    times = np.arange(200) / 100
    values = np.sin(3.0 * times)
    rows = [f"a,{t:.2f},{v:.5f},{v:.5f}" for t, v in zip(times, values, strict=True)]
    (folder / "log.csv").write_text("\n".join(["run,t,u.servo,q.wrist", *rows]), encoding="utf-8")
    return folder / "log.csv"


@pytest.mark.parametrize(
    ("integrator", "kv", "is_unstable"),
    [("Euler", 8.0, False), ("Euler", 12.0, True), ("implicitfast", 12.0, False)],
)
def test_explain_and_inspect_warn_of_unstable_servos(tmp_path, capsys, integrator, kv, is_unstable):
    path = write_recording(tmp_path, integrator, kv)
    recording, kind = load_recording(path)
    warnings = [text for text in check_recording_plausible(recording, kind) if "gains" in text]
    assert len(warnings) == is_unstable
    if is_unstable:
        assert warnings[0].startswith("servo servo: gains too large for Euler steps of 2 ms")
        assert warnings[0].endswith("implicitfast or with a time step of 1 ms")
    assert main(["inspect", str(path)]) == 0
    assert ("gains too large" in capsys.readouterr().out) == is_unstable
