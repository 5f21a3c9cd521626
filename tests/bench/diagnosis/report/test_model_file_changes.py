"""Tests of the model-file lines to change, from the original and the extended file."""

from pathlib import Path

from bench.diagnosis.report.model_file_changes import find_model_file_changes
from sims.extended_simulator import FittedValue
from sims.robot.export.write_model_file import write_model_files
from sims.robot.export.xml_editing import strip_heading
from sims.robot.parsing.read_model_file import read_robot

ROOT = Path(__file__).resolve().parents[4]
BEFORE = """<mujoco>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" damping="0.3"/>
      <inertial pos="0 0 0" mass="1"/>
      <joint name="elbow" damping="0.1"/>
    </body>
  </worldbody>
</mujoco>
"""
AFTER = """<!-- arm.xml, with what was found -->
<mujoco>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" damping="0.3"/>
      <!-- mass.scale@upper: 0.1, fitted to log.csv -->
      <inertial pos="0 0 0" mass="1.1"/>
      <!-- drag.linear@elbow: 0.2 N*m*s/rad, fitted to log.csv -->
      <!-- friction.coulomb@elbow: 0.3 N*m, fitted to log.csv -->
      <joint name="elbow" damping="0.3" frictionloss="0.3"/>
    </body>
  </worldbody>
</mujoco>
"""


def test_each_changed_line_stands_with_what_it_was_and_why():
    mass, elbow = find_model_file_changes(BEFORE, AFTER)
    assert mass.element == "inertial"
    assert mass.before == '<inertial pos="0 0 0" mass="1"/>'
    assert mass.after == '<inertial pos="0 0 0" mass="1.1"/>'
    assert mass.comment == "mass.scale@upper: 0.1, fitted to log.csv"
    assert elbow.element == "joint elbow"
    assert elbow.before == '<joint name="elbow" damping="0.1"/>'
    assert elbow.comment.count("fitted to") == 2


def test_it_does_not_matter_how_elements_lie_on_lines():
    flat = " ".join(BEFORE.split("\n"))
    spread = BEFORE.replace(" damping", "\n             damping")
    assert (
        find_model_file_changes(flat, AFTER)
        == find_model_file_changes(spread, AFTER)
        == find_model_file_changes(BEFORE, AFTER)
    )


def test_the_same_file_has_no_changes():
    assert find_model_file_changes(BEFORE, BEFORE) == ()


def test_a_line_that_is_new_has_nothing_before_it():
    plain = BEFORE.replace('      <joint name="elbow" damping="0.1"/>\n', "")
    (new,) = find_model_file_changes(plain, BEFORE)
    assert (new.before, new.after) == ("", '<joint name="elbow" damping="0.1"/>')
    (gone,) = find_model_file_changes(BEFORE, plain)
    assert (gone.element, gone.after) == ("joint elbow", "")


def test_of_a_file_that_was_written_anew_what_carries_a_comment_is_shown():
    found = find_model_file_changes("<robot><link/></robot>", AFTER)
    assert [change.element for change in found] == ["inertial", "joint elbow"]
    assert not any(change.before for change in found)


def test_the_file_of_a_robot_with_a_cause_in_it():
    arm = read_robot(ROOT / "examples/robot/arm2.xml")
    rub = {"friction.coulomb@elbow": {"coefficient": FittedValue(0.03, "N*m", 0.029, 0.031)}}
    text = write_model_files(arm, rub, "a log").xml
    (change,) = find_model_file_changes(arm.path.read_text(), strip_heading(text))
    assert change.element == "joint elbow"
    assert 'frictionloss="0.03"' in change.after
    assert "frictionloss" not in change.before
    assert "friction.coulomb@elbow: 0.03 N·m" in change.comment
