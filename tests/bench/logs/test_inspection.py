import matplotlib.image
import numpy as np
import pytest

from bench.figures.signal_thinning import thin_signal
from bench.logs.recording_loading import load_recording
from bench.logs.recording_summary import format_summary
from sims.core.noise_estimation import count_gaps, estimate_noise
from sims.core.simulator import InputError
from sims.recording.recording import read_recording
from sims.systems.servo import Servo
from tests.bench.diagnosis.report_tables import table
from tests.command_output import run_command
from tests.simulation_arguments import simulation_spec, write

RNG = np.random.default_rng(3)


def lines(path, system=None):
    return list(format_summary(*load_recording(path, system)))


@pytest.fixture
def odd(tmp_path):
    """Recording with runs of different length, rate and input, with missing samples and a gap."""
    rows = ["run,t,goal,q"]
    rows += [f"slow,{0.02 * i:.2f},0.5,{np.sin(0.1 * i):.6f}" for i in range(50)]
    rows += [
        f"fast,{0.005 * i:.3f},1,{'' if i in (7, 8) else 0.1}"
        for i in range(100)
        if not 40 <= i < 50
    ]
    rows += [f"last,{100 + 0.01 * i:.2f},1,{0.2 + 0.001 * i}" for i in range(30)]
    (tmp_path / "odd.csv").write_text("\n".join(rows))
    (tmp_path / "odd.toml").write_text(
        'system = "servo"\ntitle = "Odd"\n[channels.q]\nunit = "deg"\nnoise = 0.5\n[inputs.goal]\n'
        'unit = "rad"\n'
        "[constants]\nmass = 0.3\n[runs.fast]\nkp = 100\n[runs.last]\nkp = 100\nheld_out = true\n"
        "initial = {q = 0.25}\n"
    )
    return tmp_path / "odd.csv"


def test_summary_says_what_is_there(odd):
    said = lines(odd)
    assert said[0] == "Odd"
    assert said[1] == f"{odd}: system servo, 3 runs (1 held out), 170 samples, 1.765 s"
    rows = {line.split()[0]: line.split() for line in said[4:7]}
    assert rows["slow"] == ["slow", "fitting", "50", "0.98", "50", "20", "20", "20", "0", "0"]
    assert rows["fast"] == ["fast", "fitting", "90", "0.495", "200", "5", "5", "55", "1", "2"]
    assert rows["last"] == ["last", "held", "out", "30", "0.29", "100", "10", "10", "10", "0", "0"]
    (q,) = (line.split() for line in said if line.startswith("q "))
    assert q[:3] == ["q", "channel", "rad"]
    low, high = np.deg2rad([-1.0, 1.0])
    assert float(q[3]) == pytest.approx(low, rel=1e-3)
    assert float(q[4]) == pytest.approx(high, rel=1e-3)
    assert q[5] == "1.2%"
    assert float(q[6]) == pytest.approx(np.deg2rad(0.5), rel=0.01)
    (goal,) = (line.split() for line in said if line.startswith("goal "))
    assert goal == ["goal", "input", "rad", "0.5", "1", "0"]
    assert "kp differs by run: 200 in run slow; 100 in runs fast, last" in said
    assert "mass = 0.3 kg" in said
    assert "voltage = 7.4 V (the system's default; not stated)" in said
    assert "initial states stated: last (q = 0.25)" in said
    assert any(line.startswith("estimated: ") and "white noise" in line for line in said)


def test_a_single_run_is_one_although_its_end_is_held_out(tmp_path):
    write(simulation_spec("pendulum", runs=1), tmp_path / "a.csv")
    said = lines(tmp_path / "a.csv")
    assert said[1].endswith(
        "system pendulum, 1 run (its last third is held out), 400 samples, 3.98 s"
    )
    assert [line.split()[:4] for line in said[4:6]] == [
        ["1", "fitting", "266", "2.65"],
        ["1", "held", "out", "134"],
    ]


def test_many_runs_are_cut_short(tmp_path):
    path = table(tmp_path, [(np.arange(3), run + np.arange(3)) for run in range(300)], ["q"])
    said = lines(path)
    assert "... and 260 more runs" in said
    assert len(said) < 60
    run_command("inspect", path, "--out", tmp_path / "out")


def test_noise_is_found_under_motion_and_uneven_sampling():
    t = np.cumsum(RNG.uniform(0.005, 0.015, size=4000))
    clean = 3 * np.sin(2 * t) - 0.4 * t
    for sigma in (0.002, 0.05):
        found = estimate_noise([(t, clean + sigma * RNG.standard_normal(t.size))])
        assert found.sigma == pytest.approx(sigma, rel=0.06)
        assert found.step == 0
    noisy = clean + 0.01 * RNG.standard_normal(t.size)
    noisy[RNG.random(t.size) < 0.3] = np.nan
    noisy[500:510] += 40
    assert estimate_noise(
        [(t[:2000], noisy[:2000]), (t[2000:], noisy[2000:])]
    ).sigma == pytest.approx(0.01, rel=0.1)
    even = np.arange(1000) / 100
    rounded = estimate_noise([(even, np.round(np.sin(even) / 0.01) * 0.01)])
    assert rounded.step == pytest.approx(0.01)
    assert rounded.sigma == pytest.approx(0.01 / 12**0.5, rel=0.5)
    for few in (np.array([1.0]), np.array([1.0, np.nan, np.nan]), np.full(9, np.nan)):
        assert np.isnan(estimate_noise([(np.arange(few.size) * 1.0, few)]).sigma)
    assert estimate_noise([(even, np.full(1000, 2.0))]) == (0.0, 0.0)
    assert count_gaps(np.array([0.0, 1.0, 2.0, 4.0, 5.0])) == 1
    assert count_gaps(np.array([0.0])) == 0


def test_simulated_noise_is_found(tmp_path):
    write(
        simulation_spec("ball", ["restitution=0.9"], noise=["z=0.004"], observe=["z"]),
        tmp_path / "a.csv",
    )
    (z,) = (line.split() for line in lines(tmp_path / "a.csv") if line.startswith("z "))
    assert float(z[6]) == 0.004
    assert float(z[7]) == pytest.approx(0.004, rel=0.1)


def test_inspect_prints_and_draws_and_leaves_the_recording_alone(odd, tmp_path):
    before = {p.name: p.read_bytes() for p in odd.parent.iterdir()}
    out = run_command("inspect", odd, "--pdf", "--out", tmp_path / "out").out
    assert "kp differs by run" in out
    assert str(tmp_path / "out" / "odd.png") in out
    picture = matplotlib.image.imread(tmp_path / "out" / "odd.png")[:, :, :3]
    assert picture.shape[0] > 600
    assert picture.shape[1] > 1000
    shaded = np.abs(picture - 0xE4 / 255).max(axis=2) < 0.01
    assert 0.02 < shaded.mean() < 0.3, "the held-out run stands on grey ground"
    assert (tmp_path / "out" / "odd.pdf").read_bytes().startswith(b"%PDF")
    assert before == {p.name: p.read_bytes() for p in odd.parent.iterdir() if p.is_file()}


def test_the_figure_is_the_same_each_time(odd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_command("inspect", odd)
    folder = tmp_path / "results" / "inspect" / tmp_path.name
    first = {p.name: p.read_bytes() for p in folder.iterdir()}
    run_command("inspect", odd)
    assert sorted(first) == ["odd.png"]
    assert first == {p.name: p.read_bytes() for p in folder.iterdir()}


def test_thinning_keeps_the_extremes():
    t = np.arange(100_000) / 100
    y = np.sin(t)
    y[31_415], y[27_182], y[50_000:60_000] = 9.0, -9.0, np.nan
    kept = thin_signal(y, 4000)
    thin_t, thin_y = t[kept], y[kept]
    assert thin_t.size <= 4000
    assert (np.diff(thin_t) > 0).all()
    assert (np.nanmax(thin_y), np.nanmin(thin_y)) == (9.0, -9.0)
    assert np.isnan(thin_y[(thin_t > 501) & (thin_t < 599)]).all()
    assert thin_signal(y[:4000], 4000).size == 4000


def test_faults_are_one_line(odd, tmp_path):
    for arguments, message in [
        ([str(tmp_path / "none.csv")], "none.csv: no such file"),
        ([str(odd), "--system", "serv"], f"{odd}: unknown simulator 'serv'; there are: "),
        ([str(odd), "--system", "ball"], "unknown channel in"),
        ([str(odd), "--out", str(odd / "below")], "cannot be written (Not a directory)"),
    ]:
        captured = run_command("inspect", *arguments, code=2).err
        assert message in captured
        assert captured.count("\n") == 1
    odd.with_suffix(".toml").write_text(
        odd.with_suffix(".toml").read_text().replace("servo", "sled")
    )
    with pytest.raises(InputError, match="unknown simulator 'sled'"):
        load_recording(odd)


def test_every_real_recording_is_inspected(recordings, tmp_path):
    paths = sorted(recordings.rglob("*.csv"))
    assert len(paths) == 15
    for path in paths:
        recording, kind = load_recording(path)
        said = list(format_summary(recording, kind))
        noise = [line.split()[-1] for line in said if " channel " in line]
        assert noise
        assert len(said) > 8
    for path in (
        paths[0],
        recordings / "servo_pendulum" / "recording.csv",
        recordings / "smartphone_fall" / "fall.csv",
    ):
        run_command("inspect", path, "--out", tmp_path)
        assert (tmp_path / f"{path.stem}.png").stat().st_size > 30_000


def test_real_servo_has_the_encoder_step_of_its_description(recordings):
    path = recordings / "servo_pendulum" / "recording.csv"
    runs = read_recording(path, Servo).runs
    found = estimate_noise([(run.times, run.channels["q"]) for run in runs])
    assert found.step == pytest.approx(0.00153, rel=0.01)
    (row,) = (line for line in lines(path) if line.startswith("q "))
    assert row.endswith("in steps of 0.00153")


def test_real_phone_has_about_the_noise_that_was_published(recordings):
    path = recordings / "smartphone_fall" / "fall.csv"
    (row,) = (line.split() for line in lines(path) if line.startswith("accel_z"))
    assert float(row[6]) == 0.022
    assert float(row[7]) == pytest.approx(0.022, rel=0.3)
