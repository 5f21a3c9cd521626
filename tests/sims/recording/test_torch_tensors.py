"""Tests of tensors in PyTorch files: written by torch, read without torch and without
unpickling.
"""

import subprocess
import sys
import zipfile
from collections import OrderedDict

import numpy as np
import pytest

from sims.core.simulator import InputError
from sims.recording.log_formats.log_files import read_log

torch = pytest.importorskip("torch")

TIMES = np.arange(120) / 50.0
Q = np.column_stack([np.sin(3 * TIMES), 0.5 * np.cos(2 * TIMES)])


def saved(path, content, **options):
    torch.save(content, path, **options)
    return path


@pytest.mark.parametrize("kind", ["float64", "float32", "float16", "bfloat16", "int64", "int16"])
def test_numbers_of_any_type_and_layout(kind, tmp_path):
    whole = (torch.arange(24).reshape(4, 6) - 7).to(getattr(torch, kind))
    content = {"a": whole, "part": whole[1:, ::2], "turned": whole.T, "one": whole[:, 3],
               "same": whole[0].expand(4, 6), "flag": whole[:, 0] > 0}  # fmt: skip
    log = read_log(saved(tmp_path / "log.pt", content))
    for name, tensor in content.items():
        np.testing.assert_array_equal(log.columns[name], tensor.to(torch.float64).numpy())


def test_containers_and_other_objects(tmp_path):
    content = OrderedDict(
        obs={"q": torch.ones(3, 2), "label": "x", "none": None},
        runs=[torch.zeros(3), torch.ones(3)],
        weight=torch.nn.Parameter(torch.ones(3)),
        image=torch.zeros(3, 2, 2),
        kind=np.dtype("f8"),
    )
    log = read_log(saved(tmp_path / "log.pth", content))
    assert set(log.columns) == {"obs/q", "runs/0", "runs/1", "weight"}
    assert read_log(saved(tmp_path / "one.pt", torch.ones(4))).list_columns() == ["tensor"]


def test_a_log_of_tensors_is_read_without_torch(tmp_path):
    content = {"time": torch.tensor(TIMES), "q": torch.tensor(Q[:, ::-1].copy()),
               "joint_names": ["knee", "hip"]}  # fmt: skip
    saved(tmp_path / "log.pt", content)
    code = f"""import sys
from sims.recording.log_formats.log_files import read_log
assert read_log({str(tmp_path / "log.pt")!r}).list_columns() == ["time", "q.knee", "q.hip"]
assert "torch" not in sys.modules and "h5py" not in sys.modules"""
    subprocess.run([sys.executable, "-c", code], check=True)


class Bomb:
    def __reduce__(self):
        return (pytest.fail, ("it was unpickled",))


def test_nothing_is_unpickled(tmp_path):
    log = read_log(saved(tmp_path / "log.pt", {"q": torch.ones(3), "bomb": Bomb()}))
    assert log.list_columns() == ["q"]


def test_what_is_no_archive_is_one_line(tmp_path):
    old = saved(tmp_path / "old.pt", {"q": torch.ones(3)}, _use_new_zipfile_serialization=False)
    with pytest.raises(InputError, match=r"old.pt: expected a PyTorch file as a zip archive"):
        read_log(old)
    with zipfile.ZipFile(tmp_path / "many.pt", "w") as archive:
        # Lists nested a hundred times at each level: a small file that is endless when expanded.
        inner = b"](" + b"K\x01" * 2 + b"e"
        for level in range(1, 12):
            own = bytes([level])
            inner = inner + b"q" + own + b"0](" + (b"h" + own) * 100 + b"e"
        archive.writestr("a/data.pkl", b"\x80\x02" + inner + b".")
    with pytest.raises(
        InputError, match=r"many.pt: not a PyTorch file that can be read: too many entries"
    ):
        read_log(tmp_path / "many.pt")
