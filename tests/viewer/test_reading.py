"""Files that can be watched, and clear words about those that cannot."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from magnet.body import Body
from magnet.export.formats import write
from magnet.export.npz import save_smplx
from magnet.export.page.takes import numbered, same_length, take, takes
from magnet.export.read_options import Reading
from magnet.export.trace import DenoisingTrace
from magnet.motion.scene import Scene
from magnet.testing import random_scene
from magnet.viewer.reading import read_takes


def test_a_scene_files_samples_are_takes_with_labels_that_differ(tmp_path: Path, scene: Scene, body: Body) -> None:
    path = scene.save(tmp_path / "dance.npz")
    found, _ = read_takes([path, path], body, context=8)
    assert len(found) == 2 * scene.scenes
    assert found[0].known[:8].all()
    assert not found[0].known[8:].any()
    assert {each.label for each in found} == {"dance · 1", "dance · 2"}


def test_samples_that_have_names_are_named_by_their_file_and_these(scene: Scene) -> None:
    samples = scene.replace(names=("sample 1", "sample 2"))
    assert [each.label for each in takes(samples, "dance")] == ["dance · sample 1", "dance · sample 2"]
    assert [each.label for each in takes(samples.select([1]), "dance")] == ["sample 2"]
    assert [each.label for each in takes(scene.replace(names=("a", "a")), "dance")] == ["a · 1", "a · 2"]


def test_labels_that_end_in_a_number_are_not_given_to_others(duet: Scene) -> None:
    labels = ["a", "a", "a (1)", "b", "a"]
    named = [each.label for each in numbered([take(label, duet) for label in labels])]
    assert named[2:4] == ["a (1)", "b"] and len(set(named)) == 5 and all(name.startswith("a (") for name in named[:2])


def test_a_part_of_a_file_is_shown(tmp_path: Path, duet: Scene, body: Body) -> None:
    path = duet.save(tmp_path / "dance.npz")
    found, _ = read_takes([path], body, options=Reading(start=2, end=6))
    assert torch.equal(found[0].scene.T_world_root, duet.slice(2, 6).T_world_root)


def test_smplx_files_are_shown_where_they_were_written_from(tmp_path: Path, duet: Scene, body: Body) -> None:
    path = save_smplx(duet, tmp_path / "dance.npz", body)[0]
    found, _ = read_takes([path], body)
    torch.testing.assert_close(found[0].scene.T_world_root, duet.T_world_root, atol=1e-5, rtol=0)


def test_absent_people_are_not_shown_and_the_others_keep_their_slots(scene: Scene) -> None:
    present = torch.tensor([[True, False, True]])
    shown = take("x", scene.select([0]).replace(present=present))
    assert shown.slots == (0, 2)
    assert shown.scene.agents == 2


def test_steps_of_denoising_show_nobody_who_is_absent(scene: Scene) -> None:
    some = scene.select([0]).replace(present=torch.tensor([[True, False, True]]))
    levels = torch.arange(3).expand(2, some.frames // 4, 3)
    steps = DenoisingTrace(some, levels, torch.zeros(2, dtype=torch.long), some.repeat(2))
    shown = take("x", some, recording=steps).recording
    assert shown is not None and shown.at(1).present.tolist() == [[True, True]]
    assert shown.levels.shape[-1] == 2 and shown.levels.unique().tolist() == [0, 2]


def test_a_scene_that_says_what_was_given_knows_better_than_a_context(duet: Scene) -> None:
    given = torch.zeros(1, duet.frames, 2, dtype=torch.bool)
    given[:, 5, 0] = True
    said = duet.replace(given=given)
    shown = take("x", said, context=8)
    assert (shown.known == given[0].numpy()).all()
    assert [shown.said(frame) for frame in (4, 5, duet.frames)] == ["", "given: person 1", "ended"]
    assert take("x", duet, context=8).scene.given.sum() == 16
    assert take("x", duet).scene.given is None


def test_same_length_cuts_or_holds(duet: Scene) -> None:
    short, long = take("a", duet.slice(0, 10)), take("b", duet)
    assert same_length(long, short).frames == 10
    held = same_length(short, long)
    assert held.frames == 24
    torch.testing.assert_close(held.T_world_root[:, -1], duet.T_world_root[:, 9])


def test_mixed_frame_rates_are_named_with_their_files(tmp_path: Path, duet: Scene, body: Body) -> None:
    paths = [duet.save(tmp_path / "a.npz"), duet.replace(fps=60.0).save(tmp_path / "b.npz")]
    with pytest.raises(ValueError, match=r"mixed frame rates.*a\.npz has 30, b\.npz has 60"):
        read_takes(paths, body)


@pytest.mark.parametrize(
    ("name", "content"),
    [("cut.npz", b"PK\x03\x04 half"), ("empty.npz", b""), ("words.npz", b"hello"), ("words.txt", b"hello")],
)
def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, body: Body, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ValueError, match=name.replace(".", r"\.")):
        read_takes([path], body)


def test_a_damaged_archive_is_named(tmp_path: Path, body: Body, duet: Scene) -> None:
    path = duet.save(tmp_path / "damaged.npz")
    raw = bytearray(path.read_bytes())
    raw[200:400] = bytes(200)
    path.write_bytes(bytes(raw))
    with pytest.raises(ValueError, match=r"damaged\.npz"):
        read_takes([path], body)


def test_a_missing_file_is_named(tmp_path: Path, body: Body) -> None:
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read_takes([tmp_path / "nowhere.npz"], body)


def test_another_bodys_scene_asks_for_the_body(tmp_path: Path, duet: Scene, body: Body) -> None:
    path = duet.replace(body="smplx-neutral").save(tmp_path / "a.npz")
    with pytest.raises(ValueError, match=r"smplx-neutral.*--body"):
        read_takes([path], body)


def test_numbers_that_are_not_finite_and_empty_scenes_are_refused(duet: Scene) -> None:
    broken = duet.T_world_root.clone()
    broken[0, 5] = float("nan")
    with pytest.raises(ValueError, match="first is frame 5"):
        take("x", duet.replace(T_world_root=broken))
    with pytest.raises(ValueError, match="nothing to see"):
        take("x", duet.replace(present=torch.zeros(1, 2, dtype=torch.bool)))


def test_frames_that_were_looked_at_before_are_not_looked_at_again(duet: Scene) -> None:
    """Of a scene that has grown; those that are new are named by their numbers in the whole of it."""
    broken = duet.body_rot.clone()
    broken[:, 7] = torch.nan
    scene = duet.replace(body_rot=broken)
    with pytest.raises(ValueError, match="body_rot is not finite in 1 frames, the first is frame 7"):
        take("", scene, looked_at=5)
    assert take("", scene, looked_at=8).frames == duet.frames


def test_only_the_first_samples_of_a_large_file_are_shown(generator: torch.Generator) -> None:
    assert len(takes(random_scene(6, 8, 1, generator), "x", samples=3)) == 3


def test_other_npz_files_are_refused_with_what_they_hold(tmp_path: Path, body: Body) -> None:
    path = tmp_path / "other.npz"
    np.savez(path, cats=np.zeros(3), meta=np.array(json.dumps({})))
    with pytest.raises(ValueError, match=r"other\.npz"):
        read_takes([path], body)


def test_files_of_one_person_each_are_scenes_of_their_own_which_is_said(
    tmp_path: Path, duet: Scene, body: Body
) -> None:
    said: list[str] = []
    alone = [write(duet.permute_agents(torch.tensor([p])), tmp_path / f"a {p}.bvh", body)[0] for p in (0, 1)]
    found, _ = read_takes(alone, body, say=said.append)
    assert [each.scene.agents for each in found] == [1, 1]
    words = f"magnet export '{alone[0]}' '{alone[1]}' together.npz"
    assert said[-1] == f"each file is a scene of its own; if they are people of one: {words}, then view it"
    both = write(duet, tmp_path / "both.npz", body)[0]
    for paths in ([alone[0]], [both, alone[0]]):
        said.clear()
        read_takes(paths, body, say=said.append)
        assert not any("scene of its own" in line for line in said)
