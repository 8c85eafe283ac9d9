"""`magnet predict FILE...` as a person with recordings would use it."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from magnet import cli
from magnet.body import load_body
from magnet.checkpoints import FOLDER
from magnet.cli.predict_files import parser
from magnet.denoiser.core import DenoiserCore
from magnet.export import reading, save_bvh
from magnet.export.npz import save_smplx
from magnet.motion.scene import Scene
from magnet.sampling.presets import PRESETS
from magnet.tasks import registry
from tests.cases import few, some_quick, some_slow

QUICK = ["--sampler.steps", "2"]
GOING_ON = ("joint_future", "partner_prediction", "agentic_sync", "agentic_async")
"""Tasks that read nothing of a recording after its context."""
NO_PAST = ("generation", "partner_inpainting")
"""Tasks that are not given everybody's past."""


@pytest.fixture(scope="module")
def duet(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """One duet as a scene of ours, as SMPL-X files and as BVH files of another rate."""
    folder, body = tmp_path_factory.mktemp("recorded"), load_body()
    scene = Scene.load(FOLDER / "duet" / "scenes" / "duet.npz").slice(0, 48)
    return {
        "ours": [str(scene.save(folder / "duet.npz"))],
        "smplx": [str(path) for path in save_smplx(scene, folder / "smplx.npz", body)],
        "bvh": [str(path) for path in save_bvh(scene, folder / "a.bvh", body, unit="cm")],
    }


def said(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """What is printed by a command that must not fail."""
    assert cli.main(["predict", *words]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("task", some_quick(registry.names(), "joint_future", "inbetweening"))
def test_every_task_goes_from_files_to_a_file(task, duet, tmp_path, capsys) -> None:
    out = tmp_path / "out.npz"
    said(capsys, *duet["bvh"], "--task", task, "--frames", "16", "--out", str(out), *QUICK)
    made, recorded = Scene.load(out), Scene.load(duet["ours"][0])
    frames = 48 + 16 if task in GOING_ON else 16 if task in NO_PAST else 32 + 16
    assert (made.frames, made.present.tolist()) == (frames, [[True, True]])
    assert made.given is not None
    assert task not in GOING_ON or made.given[0, :48].all()
    joints, truth = load_body().joints(made)[:, :48], load_body().joints(recorded)[:, : made.frames]
    given = made.given[0, :48]
    assert torch.isfinite(joints).all()
    assert given.any() == (task != "generation")
    assert (joints - truth)[0][given].abs().max() < 1e-3 if given.any() else True


@pytest.mark.parametrize("kind", some_slow(["ours", "smplx", "bvh"], "smplx"))
def test_whoever_wrote_the_files_the_given_people_are_as_recorded(kind, duet, tmp_path, capsys) -> None:
    out = tmp_path / "out.npz"
    said(capsys, *duet[kind], "--task", "partner_inpainting", "--context", "0", "--out", str(out), *QUICK)
    made, recorded, body = Scene.load(out), Scene.load(duet["ours"][0]), load_body()
    assert made.frames == recorded.frames
    assert (body.joints(made) - body.joints(recorded))[0, :, 1].abs().max() < 1e-3
    assert (body.joints(made) - body.joints(recorded))[0, :, 0].abs().max() > 0.05


def test_a_person_alone_gets_a_partner(duet, tmp_path, capsys) -> None:
    out = tmp_path / "out.npz"
    said(capsys, duet["bvh"][1], "--people", "2", "--task", "partner_inpainting", "--out", str(out), *QUICK)
    made, recorded, body = Scene.load(out), Scene.load(duet["ours"][0]), load_body()
    assert made.present.tolist() == [[True, True]]
    assert (body.joints(made)[0, :, 0] - body.joints(recorded)[0, :, 1]).abs().max() < 1e-3


def test_what_goes_on_stands_behind_all_of_the_recording(duet, tmp_path, capsys) -> None:
    """Also behind frames in front of whole tokens, so that music and cameras of the recording still fit."""
    recorded, out = Scene.load(duet["ours"][0]).slice(0, 47), tmp_path / "out.npz"
    recorded.save(tmp_path / "long.npz")
    words = (str(tmp_path / "long.npz"), "--frames", "4", "--samples", "2", "--out", str(out), *QUICK)
    text = said(capsys, *words)
    assert "of 47 frames the last 44 are read, in tokens of 4 frames, the 3 before them stay in front" in text
    assert "102 frames, of which 94 are given" in text
    made = Scene.load(out)
    assert made.frames == 47 + 4 and made.given[:, :47].all() and not made.given[:, 47:].any()
    for sample in range(2):
        assert torch.equal(made.body_rot[sample, :47], recorded.body_rot[0])
        assert torch.equal(made.T_world_root[sample, :47], recorded.T_world_root[0])
    apart = Scene.load(tmp_path / "long.npz").slice(3).save(tmp_path / "apart.npz")
    said(capsys, str(apart), *words[1:])
    assert torch.equal(Scene.load(out).T_world_root, made.T_world_root[:, 3:]), "what is made is as without them"


@pytest.mark.parametrize("case", ["recorded", "to the end", "not recorded"])
def test_whom_a_task_leaves_out_is_as_recorded_or_said_to_stand_still(case: str, duet, tmp_path, capsys) -> None:
    out, recorded = tmp_path / "out.npz", Scene.load(duet["ours"][0])
    context, frames, end, line = {
        "recorded": (32, 8, 40, "person 1 is not made by partner_prediction: as recorded in frames 32 to 39\n"),
        "to the end": (32, 24, 48, "as recorded in frames 32 to 47, and stands still from frame 48\n"),
        "not recorded": (48, 8, 48, "person 1 is not made by partner_prediction and stands still from frame 48\n"),
    }[case]
    words = ("--task", "partner_prediction", "--context", str(context), "--frames", str(frames), "--out", str(out))
    text = said(capsys, *duet["ours"], *words, *QUICK)
    made = Scene.load(out)
    assert line in text and f"{context + frames} frames, of which {context} are given" in text
    assert torch.equal(made.T_world_root[:, :end, 1], recorded.T_world_root[:, :end, 1])
    assert torch.equal(made.body_rot[:, :end, 1], recorded.body_rot[:, :end, 1])
    still = made.T_world_root[:, end - 1 :, 1]
    assert torch.equal(still, still[:, :1].expand_as(still))
    assert made.given[0].sum(dim=0).tolist() == [context, context + frames], "pictures show it as not made"


def test_given_frames_that_are_not_valid_are_said(duet, tmp_path, capsys) -> None:
    recorded = Scene.load(duet["ours"][0])
    valid = torch.ones(recorded.scenes, recorded.frames, dtype=torch.bool)
    valid[:, 36:38] = False
    file = str(recorded.replace(valid=valid).save(tmp_path / "gaps.npz"))
    words = ("--context", "40", "--frames", "8", "--out", str(tmp_path / "o.npz"))
    text = said(capsys, file, *words, *QUICK)
    assert "of what is given, 2 frames from 36 to 37 are marked as not valid" in text
    assert (~Scene.load(tmp_path / "o.npz").valid[0]).nonzero()[:, 0].tolist() == [36, 37], "and stay so"
    assert "not valid" not in said(capsys, *duet["ours"], *words, *QUICK)


def test_a_recording_that_is_put_in_afterwards_changes_nothing_that_is_made(duet, tmp_path, capsys) -> None:
    recorded = Scene.load(duet["ours"][0])
    other = recorded.T_world_root.clone()
    other[:, 32:, 1, 0, 3] += 0.5
    recorded.replace(T_world_root=other).save(tmp_path / "other.npz")
    made = []
    for path in (duet["ours"][0], str(tmp_path / "other.npz")):
        words = ("--task", "partner_prediction", "--context", "32", "--frames", "16", "--out", str(tmp_path / "o.npz"))
        said(capsys, path, *words, *QUICK)
        made.append(Scene.load(tmp_path / "o.npz"))
    first, second = made
    assert torch.equal(first.T_world_root[:, :, 0], second.T_world_root[:, :, 0])
    assert torch.equal(first.body_rot[:, :, 0], second.body_rot[:, :, 0])
    assert not torch.equal(first.T_world_root[:, :, 1], second.T_world_root[:, :, 1])


def test_a_task_that_is_given_nothing_says_that_files_tell_who_is_there(duet, tmp_path, capsys) -> None:
    out = tmp_path / "out.npz"
    words = ("--task", "generation", "--frames", "12", "--out", str(out))
    text = said(capsys, *duet["ours"], *words, *QUICK)
    assert "generation is given no motion: of the files only the number and shapes of people are read" in text
    made = Scene.load(out)
    assert (made.frames, bool(made.given.any()), made.agents) == (12, False, 2)
    assert torch.equal(made.betas, Scene.load(duet["ours"][0]).betas)


def test_what_is_given_is_counted_for_each_person(duet, tmp_path, capsys) -> None:
    out = str(tmp_path / "out.npz")
    keys = ("--task", "inbetweening", "--context", "0", "--task.keys", "[0, 4, -1]", "--out", out)
    assert "inbetweening: 48 frames, of which 12 are given," in said(capsys, *duet["ours"], *keys, *QUICK)
    one = ("--task.agents", "[1]")
    text = said(capsys, *duet["ours"], *keys, *one, *QUICK)
    assert "of which 0 of person 0 and 12 of person 1 are given," in text


def test_keyframes_that_nobody_can_reach_are_warned_of(duet, tmp_path, capsys) -> None:
    recorded = Scene.load(duet["ours"][0])
    roots = recorded.T_world_root.clone()
    roots[:, 24:, 1, 0, 3] += 9.0
    recorded.replace(T_world_root=roots).save(tmp_path / "far.npz")
    keys = ("--task", "inbetweening", "--context", "0", "--task.keys", "[0, -1]", "--out", str(tmp_path / "o.npz"))
    text = said(capsys, str(tmp_path / "far.npz"), *keys, *QUICK)
    assert "warning: keyframe of person 1 at frame 44 (1.5 s): " in text and "too far" in text


@pytest.mark.parametrize(("context", "given", "unread"), [(38, 36, 12), (32, 32, 16), (48, 48, 0)])
def test_a_context_is_of_whole_tokens_and_what_is_not_read_after_it_is_said(
    context: int, given: int, unread: int, duet, tmp_path, capsys
) -> None:
    out = tmp_path / "out.npz"
    text = said(capsys, *duet["ours"], "--context", str(context), "--frames", "4", "--out", str(out), *QUICK)
    made, recorded = Scene.load(out), Scene.load(duet["ours"][0])
    assert made.frames == given + 4
    assert torch.equal(made.body_rot[:, :given], recorded.body_rot[:, :given])
    assert (f"--context {context}: {given} are given" in text) == (given < context)
    assert (f"{unread} of 48 recorded frames come after it and are not read" in text) == (unread > 0)


def test_a_crowd_of_files_begins_with_their_last_second(duet, tmp_path, capsys) -> None:
    text = said(capsys, *duet["ours"], "--people", "5", "--frames", "4", "--out", str(tmp_path / "crowd.npz"), *QUICK)
    made, recorded = Scene.load(tmp_path / "crowd.npz"), Scene.load(duet["ours"][0])
    assert "the crowd begins with the last 32 of 48 frames" in text and made.frames == 36
    assert torch.equal(made.body_rot[:, :32, [2, 3]], recorded.body_rot[:, 16:])


def test_a_folder_is_answered_by_the_files_in_it(duet, tmp_path, capsys) -> None:
    folder = Path(duet["bvh"][0]).parent
    assert cli.main(["predict", str(folder), "--out", str(tmp_path / "out.npz")]) == 2
    assert f"{folder} is a folder: give its files, {duet['bvh'][0]} {duet['bvh'][1]}" in capsys.readouterr().err


def test_a_short_file_is_given_whole(duet, tmp_path, capsys) -> None:
    Scene.load(duet["ours"][0]).slice(0, 14).save(tmp_path / "short.npz")
    said(capsys, str(tmp_path / "short.npz"), "--frames", "4", "--out", str(tmp_path / "out.npz"), *QUICK)
    assert Scene.load(tmp_path / "out.npz").frames == 14 + 4, "though whole tokens are read"


def test_the_seed_decides_and_several_kinds_are_written(duet, tmp_path, capsys) -> None:
    made = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        outs = [str(tmp_path / f"{name}.npz"), str(tmp_path / f"{name}.glb")]
        text = said(capsys, *duet["ours"], "--frames", "8", "--seed", str(seed), "--out", *outs, *QUICK)
        assert f"seed {seed}" in text and all(f"written: {out}" in text for out in outs)
        made.append(Scene.load(outs[0]).body_rot)
    assert torch.equal(made[0], made[1]) and not torch.equal(made[0], made[2])


def test_out_may_be_said_twice() -> None:
    assert parser().parse_intermixed_args(["a.bvh", "--out", "o.glb", "--out", "o.mp4", "p.npz"]).out == [
        "o.glb",
        "o.mp4",
        "p.npz",
    ]


def test_a_crowd_is_composed_of_the_people_of_files(duet, tmp_path, capsys) -> None:
    words = ("--people", "7", "--context", "16", "--frames", "4", "--out", str(tmp_path / "crowd.npz"), *QUICK)
    said(capsys, *duet["ours"], *words)
    made, recorded = Scene.load(tmp_path / "crowd.npz"), Scene.load(duet["ours"][0])
    assert (made.frames, made.present.tolist()) == (20, [[True] * 7])
    assert torch.equal(made.body_rot[:, :16, [2, 3]], recorded.body_rot[:, :16])


def test_people_come_from_nothing_without_files(tmp_path, capsys) -> None:
    said(capsys, "--people", "3", "--frames", "8", "--out", str(tmp_path / "trio.npz"), *QUICK)
    assert Scene.load(tmp_path / "trio.npz").present.tolist() == [[True] * 3]


@pytest.mark.slow
def test_a_crowd_comes_from_nothing_as_far_apart_as_is_said(tmp_path, capsys) -> None:
    words = ("--people", "6", "--frames", "8", "--spacing", "8", "--out", str(tmp_path / "crowd.npz"), *QUICK)
    said(capsys, *words)
    made = Scene.load(tmp_path / "crowd.npz")
    assert (made.frames, made.agents, bool(made.given.any())) == (8, 6, False)
    middles = made.T_world_root[0, 0, :, [0, 2], 3].view(3, 2, 2).mean(dim=1)
    assert (torch.cdist(middles, middles) + 99 * torch.eye(3)).min() > 6.0


@pytest.mark.parametrize(
    ("words", "message"),
    few(
        [
            ("BVH", "say where to: --out FILE"),
            ("BVH --out a.obj", "nothing writes .obj"),
            ("BVH --out a.npz --context 400", "the files hold 48 frames"),
            ("BVH --out a.npz --context 2", "a token is 4 frames; give as many or more, or 0"),
            ("BVH --out a.npz --people 1", "expected at least 2, as many as IN holds"),
            ("BVH --out a.npz --samples 99999999999", "--samples 99999999999: expected 1 to 10,000"),
            ("BVH --out a.npz --sampler.blend 99999999999999999999", "blend: got 99999999999999999999, expected"),
            ("BVH --out a.npz --sampler.pairwise_weight 1e30", "pairwise_weight: got 1e+30, expected"),
            ("BVH --out a.npz --people 3", "joint_future reads motion of person 2, of whom no file tells"),
            ("BVH --out a.npz --sampler.stps 3", "no option --sampler.stps; did you mean --sampler.steps?"),
            ("BVH --out a.npz --sampler steddy", "did you mean steady?"),
            ("BVH --out a.npz --task partner_inpaintin", "did you mean partner_inpainting?"),
            ("BVH --out a.npz --task inbetweening --task.evry 3", "did you mean --task.every?"),
            ("BVH --out a.npz --spacing 4", "--spacing 4: places the groups of a crowd, which begins above 4 people"),
            ("BVH --out a.npz --fps 60", "magnet export chooses it: write an .npz, then export that"),
            (
                "BVH --out a.npz --picture mp4",
                "suffix of --out says what is written. See magnet predict --help files",
            ),
            ("BVH --out a.npz --data.root x", "no option --data.root; it is for a data set, which is sampled without"),
            ("none.bvh --out a.npz", "none.bvh: no such file"),
            ("none.npz --task joint_future", "none.npz: no such file"),
            ("one.npz --task partner_inpainting --out a.npz", "`magnet predict --people 2` adds another"),
            ("--task joint_future BVH --out a.obj", "nothing writes .obj"),
        ],
        5,
    ),
)
def test_a_mistake_is_answered_by_what_would_be_right(
    words: str, message: str, duet, tmp_path, capsys, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Scene.load(duet["ours"][0]).permute_agents(torch.tensor([0])).save("one.npz")
    assert (
        cli.main(["predict", *[part for word in words.split() for part in (duet["bvh"] if word == "BVH" else [word])]])
        == 2
    )
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error
    assert not list(tmp_path.glob("a.*"))


def test_help_of_files_names_every_preset(capsys) -> None:
    assert cli.main(["predict", "--help", "files"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert f"--sampler PRESET how to sample: {' or '.join(PRESETS)}" in said


def test_a_data_set_is_still_sampled_without_files() -> None:
    from magnet.cli.predict_files import meant

    assert not meant(["--task", "joint_future"]) and not meant([]) and not meant(["--data.path", "store.npz"])
    assert not meant(["generation"]) and not meant(["--help"]) and meant(["--help", "files"])


@pytest.mark.parametrize("option", ["--frames", "--context=8", "--style"])
def test_an_option_of_files_without_files_says_what_to_name(option: str, capsys) -> None:
    assert cli.main(["predict", option, "20", "--samples", "2"]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"magnet predict: error: {option.partition('=')[0]} goes with files")
    assert "--people 2" in said
    assert cli.main(["predict", option, "20", "--help"]) == 0, "help is never refused"


def test_options_of_files_are_those_that_a_data_set_does_not_have() -> None:
    from magnet.cli.predict_files import parser
    from magnet.cli.scene_files import OF_FILES

    known = {name for action in parser()._actions for name in action.option_strings}
    shared = {"-h", "--help", "--out", "--task", "--task.FIELD", "--people", "--samples", "--seed", "--ckpt_path"}
    assert set(OF_FILES) == known - shared - {"--sampler", "--sampler.FIELD"}


def test_files_may_stand_behind_options() -> None:
    from magnet.cli.predict_files import READ, meant

    assert READ == reading.READ
    assert meant(["--poeple", "2", "--out", "c.glb"]), "misspelt, which the parser of files says"
    assert meant(["--task", "joint_future", "a.bvh", "b.bvh", "--out", "c.glb"])
    assert meant(["--seed=3", "A.NPZ"]) and meant(["--trim", "a.bvh", "--out", "c.glb"])
    for words in (["--out", "a.npz", "b.npz"], ["--data.path", "a.npz"], ["--view", "--data.path", "a.npz"]):
        assert not meant(words), words


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none.npz"], "none.npz: no such file"),
        (["OURS", "none.txt"], "expected .npz, .pkl and .pt, or .csv files alone, or files of skeletons"),
        (["OURS", "--people", "1"], "--people 1: expected at least 2"),
        (
            ["motion.usdz"],
            "cannot read motion.usdz: expected .npz, .pkl and .pt, or .csv files alone, or files of skeletons",
        ),
        (["OURS", "--task", "joint_futur"], "did you mean joint_future?"),
        (["OURS", "--style", "light"], "--style: is for .html, .png, .mp4, .gif, .webp, and does nothing in .npz"),
        (["OURS", "--size", "64", "48"], "--size: is for .mp4, .gif, .webp, and does nothing in .npz"),
        (["OURS", "--task", "inbetweening", "--task.evry", "3"], "did you mean --task.every?"),
    ],
)
def test_what_is_wrong_without_a_model_is_said_before_one_is_loaded(
    words: list[str], message: str, duet, tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.setattr(DenoiserCore, "load", lambda *_: pytest.fail("a model was loaded"))
    words = [duet["ours"][0] if word == "OURS" else word for word in words]
    assert cli.main(["predict", *words, "--out", str(tmp_path / "out.npz")]) != 0
    assert message in capsys.readouterr().err
