"""`magnet refine`: people out of each other's bodies, on the command line."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from magnet import cli
from magnet.body import load_body
from magnet.body.contact import depth_between, overlaps
from magnet.cli.refine_shown import curves, drawn, told
from magnet.motion.scene import Scene, concatenate, empty_scene
from magnet.synthesis import synthesize


@pytest.fixture(scope="module")
def crowded() -> Scene:
    """Two who walk in one place."""
    walker = synthesize("follow", 2, 120, torch.Generator().manual_seed(0), load_body()).scene.permute_agents(
        torch.tensor([0])
    )
    T_new_world = torch.eye(4)
    T_new_world[0, 3] = 0.12
    other = walker.transformed(T_new_world)
    return walker.replace(
        body_rot=torch.cat([walker.body_rot, other.body_rot], dim=2),
        T_world_root=torch.cat([walker.T_world_root, other.T_world_root], dim=2),
        betas=walker.betas.expand(1, 2, 10),
        present=walker.present.expand(1, 2),
    )


def numbers(line: str) -> tuple[float, float]:
    """Centimetres of the deepest, and the share of frames over 10 cm."""
    words = line.split()
    return float(words[2]), float(words[words.index("10") - 3])


def test_people_are_out_of_each_other_afterwards_and_the_table_says_so(crowded: Scene, tmp_path: Path, capsys) -> None:
    scene, out = crowded.save(tmp_path / "crowded.npz"), tmp_path / "apart.npz"
    assert cli.main(["refine", str(scene), str(out), "--poses", "keep"]) == 0
    lines = capsys.readouterr().out.splitlines()
    before, after = (next(line for line in lines if line.startswith(word)) for word in ("before", "after"))
    assert numbers(before)[0] > 10 and numbers(before)[1] > 50
    assert numbers(after)[0] < 10 and numbers(after)[1] == 0, "arms may lie on arms"
    made = Scene.load(out)
    assert torch.equal(made.body_rot, crowded.body_rot), "poses stay"
    assert torch.allclose(made.T_world_root[..., 1, 3], crowded.T_world_root[..., 1, 3]), "and heights"


def test_how_it_was_is_said_before_the_correction_which_takes_long(
    crowded: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    said = []

    def corrected(scene: Scene, *_: object) -> Scene:
        said.append(capsys.readouterr().out)
        return scene

    monkeypatch.setattr("magnet.body.repair.moved_apart", corrected)
    assert cli.main(["refine", str(crowded.save(tmp_path / "a.npz")), str(tmp_path / "b.npz"), "--poses", "keep"]) == 0
    assert len(said) == 1 and said[0].startswith("before ") and capsys.readouterr().out.startswith("after ")


def test_limbs_that_stay_in_each_other_are_named_with_people_and_frames(
    crowded: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Arms may lie on arms where poses are kept."""
    scene, out = crowded.save(tmp_path / "crowded.npz"), tmp_path / "apart.npz"
    assert cli.main(["refine", str(scene), str(out), "--poses", "keep"]) == 0
    named = [line for line in capsys.readouterr().out.splitlines() if line.startswith("still over 5 cm: ")]
    made, body = Scene.load(out), load_body()
    found = overlaps(made, body)
    assert found and named[0] == f"still over 5 cm: {found[0]}"
    assert re.search(r"arm of 0 in (left|right) (upper arm|forearm) of 1, frames? \d+(-\d+)?, \d\.\d cm$", named[0])
    deep = depth_between(made, body)[0]
    assert float(deep.max()) == pytest.approx(found[0].depth, abs=1e-6)
    frames = {frame for each in found for frame in range(each.start, each.last + 1)}
    assert frames == set((deep > 0.05).nonzero()[:, 0].tolist())


def test_who_is_kept_does_not_move(crowded: Scene, tmp_path: Path) -> None:
    scene, out = crowded.save(tmp_path / "crowded.npz"), tmp_path / "apart.npz"
    assert cli.main(["refine", str(scene), str(out), "--keep", "1", "--apart", "light"]) == 0
    made = Scene.load(out)
    assert torch.equal(made.T_world_root[:, :, 1], crowded.T_world_root[:, :, 1])
    assert torch.equal(made.body_rot[:, :, 1], crowded.body_rot[:, :, 1])
    assert not torch.allclose(made.T_world_root[:, :, 0], crowded.T_world_root[:, :, 0], atol=0.02)


def test_poses_are_corrected_too_unless_they_are_to_be_kept(crowded: Scene, tmp_path: Path, capsys) -> None:
    scene, out = crowded.save(tmp_path / "crowded.npz"), tmp_path / "corrected.npz"
    assert cli.main(["refine", str(scene), str(out)]) == 0
    after = next(x for x in capsys.readouterr().out.splitlines() if x.startswith("after"))
    assert numbers(after)[1] == 0 and numbers(after)[0] < 7, "they walked in one place"
    assert not torch.equal(Scene.load(out).body_rot, crowded.body_rot)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_scenes_of_other_float_types_are_refined_in_float32(crowded: Scene, tmp_path: Path, dtype: torch.dtype) -> None:
    short = crowded.slice(0, 24)
    floats = {name: value.to(dtype) for name, value in short.tensors().items() if value.is_floating_point()}
    scene, out = short.replace(**floats), tmp_path / "apart.npz"
    same = scene.to_float32().save(tmp_path / "float32.npz"), tmp_path / "same.npz"
    assert cli.main(["refine", str(scene.save(tmp_path / "crowded.npz")), str(out)]) == 0
    assert cli.main(["refine", *map(str, same)]) == 0
    for name, value in Scene.load(same[1]).tensors().items():
        assert torch.equal(getattr(Scene.load(out), name), value), name


def test_skeleton_files_of_several_people_are_refined_as_well(crowded: Scene, tmp_path: Path, capsys) -> None:
    scene = crowded.save(tmp_path / "crowded.npz")
    assert cli.main(["export", str(scene), str(tmp_path / "two.bvh")]) == 0
    paths = sorted(map(str, tmp_path.glob("two_*.bvh")))
    capsys.readouterr()
    assert cli.main(["refine", *paths, str(tmp_path / "apart.bvh")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert numbers(next(line for line in lines if line.startswith("after")))[1] == 0
    assert len(list(tmp_path.glob("apart_*.bvh"))) == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--keep", "7"), "people 0 to 1"),
        (("--apart", "very"), "error: --apart: got very, expected light or firm. See"),
        (("--slides", "much"), "error: --slides: got much, expected a number. See"),
        (("--keep", "1.5"), "error: --keep: got 1.5, expected a whole number. See"),
        (("--plot",), "error: --plot: expected one value behind it. See"),
        (("--shapes",), "error: --shapes: expected at least one value behind it. See"),
        (("--hands", "hold", "--apart", "light"), "firm"),
    ],
)
def test_wrong_wishes_are_told_what_was_expected(crowded: Scene, tmp_path: Path, words, said, capsys) -> None:
    scene = crowded.save(tmp_path / "crowded.npz")
    assert cli.main(["refine", str(scene), str(tmp_path / "out.npz"), *words]) == 2
    assert said in capsys.readouterr().err


def test_one_person_and_unknown_formats_are_refused(crowded: Scene, tmp_path: Path, capsys) -> None:
    alone = crowded.permute_agents(torch.tensor([0])).save(tmp_path / "alone.npz")
    assert cli.main(["refine", str(alone), str(tmp_path / "out.npz"), "--poses", "keep"]) == 2
    assert "one person" in capsys.readouterr().err
    assert cli.main(["refine", str(alone), str(tmp_path / "out.xyz")]) == 2
    assert "nothing writes .xyz" in capsys.readouterr().err


def test_where_nothing_is_to_be_refined_it_says_so(crowded: Scene, tmp_path: Path, capsys) -> None:
    few = crowded.slice(0, 8)
    nobody = few.replace(present=torch.zeros_like(few.present)).save(tmp_path / "nobody.npz")
    nothing = few.replace(valid=torch.zeros(1, 8, dtype=torch.bool)).save(tmp_path / "nothing.npz")
    for path, said in ((nobody, "holds no people"), (nothing, "holds no frame that is valid")):
        assert cli.main(["refine", str(path), str(tmp_path / "out.npz")]) == 2
        assert said in capsys.readouterr().err and not (tmp_path / "out.npz").exists()


def test_a_step_out_of_frames_that_are_not_valid_is_none(crowded: Scene) -> None:
    scene = crowded.slice(0, 20)
    away = scene.T_world_root.clone()
    away[:, :5, :, 0, 3] += 50.0
    valid = torch.ones(1, 20, dtype=torch.bool)
    valid[:, :5] = False
    body = load_body()
    assert told(scene.replace(T_world_root=away, valid=valid), body) == told(scene.slice(5), body)


def test_people_in_each_other_where_frames_are_not_valid_are_not_told(crowded: Scene) -> None:
    scene = crowded.slice(0, 20)
    apart = scene.T_world_root.clone()
    apart[:, 5:, 0, 0, 3] += 5.0
    valid = torch.ones(1, 20, dtype=torch.bool)
    valid[:, :5] = False
    assert told(scene.replace(T_world_root=apart, valid=valid), load_body()).startswith("deepest 0.0 cm")


@pytest.mark.parametrize(
    ("values", "points"),
    [([torch.nan] * 3, []), ([-2.0, -1.0, torch.nan], [["162.0"] * 2] * 2), ([0.0], [["162.0"]] * 2)],
)
def test_what_counts_nowhere_or_is_under_the_floor_is_drawn_at_the_bottom(
    values: list[float], points: list[list[str]]
) -> None:
    made = {"highest lower foot, cm": torch.tensor(values)}
    picture = drawn(made, made, 30.0)
    lines = re.findall(r'<polyline points="([^"]*)"', picture)
    assert [[point.partition(",")[2] for point in line.split()] for line in lines] == points
    assert re.findall(r'text-anchor="end">([^<]*)<', picture) == ["1", "0"]


def test_a_picture_shows_every_measure_over_time_before_and_after(crowded: Scene, tmp_path: Path) -> None:
    scene, plot = crowded.slice(0, 40).save(tmp_path / "crowded.npz"), tmp_path / "over_time.svg"
    assert cli.main(["refine", str(scene), str(tmp_path / "out.npz"), "--poses", "keep", "--plot", str(plot)]) == 0
    lines = re.findall(r'<polyline points="([^"]*)" class="(before|after)"', plot.read_text())
    assert [which for _, which in lines] == ["before", "after"] * 5
    assert all(len(points.split()) == 40 for points, _ in lines)
    heights = [float(point.partition(",")[2]) for point in lines[0][0].split()]
    assert min(heights) < 0.5 * (42 + 162), "the deepest reaches the top of its strip"


def test_the_picture_leaves_out_frames_that_are_not_valid(crowded: Scene) -> None:
    scene = crowded.slice(0, 20)
    away = scene.T_world_root.clone()
    away[:, 8:12, 0, 0, 3] += 50.0
    valid = torch.ones(1, 20, dtype=torch.bool)
    valid[:, 8:12] = False
    made = curves(scene.replace(T_world_root=away, valid=valid), load_body())
    plain = curves(scene, load_body())
    for title, values in made.items():
        left_out = slice(8, 13) if "m/s" in title else slice(8, 12)
        assert values[left_out].isnan().all()
        assert torch.equal(values.isnan().sum(), torch.tensor(left_out.stop - left_out.start))
        assert torch.allclose(values[14:], plain[title][14:])
    lines = re.findall(r'<polyline points="([^"]*)" class="before"', drawn(made, made, 30.0))
    assert [len(points.split()) for points in lines[:4]] == [8, 8, 8, 7]


def _bones(path: Path) -> list[str]:
    return re.findall(r"(?:ROOT|JOINT) (\w+)", path.read_text(encoding="utf-8"))


def _renamed(path: Path) -> Path:
    """The same skeleton with bones of names that say nothing."""
    text = path.read_text(encoding="utf-8")
    for number, name in enumerate(_bones(path)):
        text = re.sub(rf"\b{name}\b", f"Bone{number:02}", text)
    strange = path.with_name(f"strange_{path.name}")
    strange.write_text(text)
    return strange


def test_people_take_each_others_bodies_or_those_of_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = synthesize("handshake", 2, 120, torch.Generator().manual_seed(0), load_body()).scene.slice(40, 100)
    betas = torch.zeros(1, 2, 10)
    betas[0, 0, 0], betas[0, 1, 0] = 1.5, -1.5
    ours, out = scene.replace(betas=betas).save(tmp_path / "ours.npz"), tmp_path / "out.npz"
    assert cli.main(["refine", str(ours), str(out), "--shapes", "exchange"]) == 0
    assert torch.equal(Scene.load(out).betas, betas.flip(1))
    plain = scene.save(tmp_path / "plain.npz")
    assert cli.main(["refine", str(plain), str(out), "--shapes", str(ours)]) == 0
    assert torch.equal(Scene.load(out).betas, betas)
    one = scene.permute_agents(torch.tensor([0])).save(tmp_path / "one.npz")
    assert cli.main(["export", str(ours), str(tmp_path / "they.bvh")]) == 0
    characters = [str(tmp_path / f"they_person{agent}.bvh") for agent in (0, 1)]
    assert cli.main(["refine", str(plain), str(out), "--shapes", *characters]) == 0
    sizes, wanted = (load_body().rest_joints(each[0])[:, 15, 1] for each in (Scene.load(out).betas, betas))
    assert torch.allclose(sizes, wanted, atol=0.02), "of other skeletons"
    strange = [_renamed(Path(path)) for path in characters]
    words = ["refine", str(plain), str(out), "--shapes", *map(str, strange)]
    assert cli.main(words) != 0, "bones of unknown names"
    told = [
        word
        for number, name in enumerate(_bones(Path(characters[0])))
        for word in ("--joint", f"{name}=Bone{number:02}")
    ]
    capsys.readouterr()
    assert cli.main([*words, *told, "--in_unit", "m", "--up", "y"]) == 0, "IN, a scene of magnet, takes none of these"
    assert "--shapes: " in capsys.readouterr().out
    assert torch.allclose(load_body().rest_joints(Scene.load(out).betas[0])[:, 15, 1], wanted, atol=0.02)
    assert cli.main(["refine", str(plain), str(out), "--in_unit", "cm"]) != 0, "but alone"
    assert cli.main(["refine", str(plain), str(out), *told[:2]]) != 0, "but alone"
    second = (
        scene.pad_agents(3).permute_agents(torch.tensor([2, 1, 0])).save(tmp_path / "second.npz")
    )  # a free slot first
    assert cli.main(["refine", str(second), str(out), "--shapes", str(ours)]) == 0
    shaped = Scene.load(out)
    assert torch.equal(shaped.betas[shaped.present], betas[0])
    capsys.readouterr()
    for words, message in (
        ([str(ours), "--shapes", str(one)], "holds 1 person, expected 2 or more"),
        ([str(one), "--shapes", "exchange"], "expected two people or more"),
        ([str(ours), "--shapes", "exchange", "--keep", "0"], "changes everybody's pose"),
        ([str(ours), "--shapes", str(tmp_path / "none.npz")], "no such file"),
    ):
        assert cli.main(["refine", words[0], str(out), *words[1:]]) != 0
        assert message in capsys.readouterr().err


def test_the_plot_is_of_the_first_scene_with_people(crowded: Scene, tmp_path: Path) -> None:
    walkers = crowded.slice(0, 12)
    nobody = empty_scene(1, 12, 2, walkers.betas)
    scene, plot = concatenate([nobody, walkers]).save(tmp_path / "two.npz"), tmp_path / "over_time.svg"
    assert cli.main(["refine", str(scene), str(tmp_path / "out.npz"), "--plot", str(plot)]) == 0
    depth, *_ = re.findall(r'<polyline points="([^"]*)" class="before"', plot.read_text())
    assert len({point.partition(",")[2] for point in depth.split()}) > 1  # of two in one place, no flat line
