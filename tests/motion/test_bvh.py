"""Headers of BVH files as programs write them, and what none may hold."""

from __future__ import annotations

import pytest

from magnet.motion.bvh import BvhHeader, bvh_header

TEXT = """HIERARCHY
ROOT hips
{
  OFFSET 0 90 0
  CHANNELS 6 XPOSITION Yposition zposition Zrotation xrotation YROTATION
  JOINT
  {
    OFFSET 1 2 3
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 4 5 6
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0333
"""


def header(text: str = TEXT) -> BvhHeader:
    return bvh_header(text.splitlines(), "a.bvh")


def test_a_header_is_read_in_any_case_and_a_joint_without_a_name_gets_a_number() -> None:
    read = header()
    assert [(joint.name, joint.parent, joint.end) for joint in read.joints] == [
        ("hips", -1, False), ("joint1", 0, False), ("", 1, True),
    ]  # fmt: skip
    assert [joint.offset for joint in read.joints] == [(0, 90, 0), (1, 2, 3), (4, 5, 6)]
    assert read.joints[0].channels == (
        "Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation",
    )  # fmt: skip
    assert (read.width, read.frames, read.seconds, read.digits, read.first) == (9, 2, 0.0333, 4, 18)


@pytest.mark.parametrize("said", ["", "OFFSET 4 5 6\n      CHANNELS 0", "OFFSET 4 5 6\n CHANNELS 3 Xrotation a b"])
def test_what_an_end_site_says_moves_nothing(said: str) -> None:
    assert header(TEXT.replace("OFFSET 4 5 6", said)).width == 9


@pytest.mark.parametrize(
    ("frames", "seconds", "fine"),
    [(1, "9.9", True), (1, "0.0001", True), (0, "0.1", False), (-1, "0.1", False), (1, "10", False), (1, "0", False)],
)
def test_there_is_a_frame_at_least_and_none_of_ten_seconds(frames: int, seconds: str, fine: bool) -> None:
    text = TEXT.replace("Frames: 2", f"Frames: {frames}").replace("0.0333", seconds)
    if fine:
        assert (header(text).frames, header(text).seconds) == (frames, float(seconds))
    else:
        with pytest.raises(ValueError, match="expected at least one of 0 to 10 s"):
            header(text)


WRONG = {
    "a.bvh:2: a brace before the ROOT": TEXT.replace("ROOT hips\n", ""),
    "a.bvh:16: a closing brace too many": TEXT.replace("MOTION", "}\nMOTION"),
    "a.bvh:2: OFFSET outside a joint": TEXT.replace("ROOT hips", "OFFSET 1 2 3\nROOT hips"),
    "a.bvh:2: a JOINT outside the ROOT": TEXT.replace("ROOT hips", "JOINT hips"),
    "a.bvh:16: an End Site outside the ROOT": TEXT.replace("MOTION", "End Site\n{\n}\nMOTION"),
    "a.bvh: the HIERARCHY is incomplete": TEXT.replace("    OFFSET 1 2 3\n", ""),
    "a.bvh:8: got 1 2 3 4, expected 3 finite numbers": TEXT.replace("1 2 3", "1 2 3 4"),
    "a.bvh:8: got 1 inf 3, expected 3 finite numbers": TEXT.replace("1 2 3", "1 inf 3"),
    "a.bvh:9: CHANNELS .* expected 2 of": TEXT.replace("CHANNELS 3", "CHANNELS 2"),
}


@pytest.mark.parametrize("message", WRONG)
def test_a_line_that_makes_no_sense_is_named(message: str) -> None:
    with pytest.raises(ValueError, match=message):
        header(WRONG[message])
