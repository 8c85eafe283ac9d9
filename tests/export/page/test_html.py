"""The page that plays by itself holds the scene, and nothing from elsewhere."""

import base64
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from magnet.body import Body
from magnet.body.joints import PARENTS
from magnet.export.page.html import FULL, page, save_html
from magnet.export.page.takes import ShownTake, take, takes
from magnet.motion.scene import Scene
from magnet.testing import random_scene

TYPES = {"i16": "<i2", "u16": "<u2", "u32": "<u4", "u8": "u1", "f32": "<f4"}


def contents(text: str) -> tuple[dict, dict[str, np.ndarray]]:
    """What the player reads from a page."""
    meta = json.loads(re.search(r'<script id="meta"[^>]*>(.*?)</script>', text, re.S)[1])
    data = base64.b64decode(re.search(r'<script id="data"[^>]*>(.*?)</script>', text, re.S)[1])
    arrays = {
        name: np.frombuffer(data, TYPES[at["type"]], at["length"], at["offset"]) for name, at in meta["arrays"].items()
    }
    return meta, arrays


def drawn(meta: dict, arrays: dict[str, np.ndarray], person: int, frame: int) -> np.ndarray:
    """The player's way from the page's numbers to vertices, written once more. (V, 3)"""
    M = len(meta["people"])
    w, x, y, z = (arrays["turns"].reshape(-1, M, 22, 4)[frame, person] / FULL).T.astype(float)
    length = np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / length, x / length, y / length, z / length
    R = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )
    shape = meta["people"][person]["shape"]
    rest = arrays["rest"].reshape(-1, 22, 3)[shape].astype(float)
    place = np.zeros((22, 3))
    place[0] = arrays["roots"].reshape(-1, M, 3)[frame, person]
    for j in range(1, 22):
        place[j] = place[PARENTS[j]] + R[PARENTS[j]] @ (rest[j] - rest[PARENTS[j]])
    bones = arrays["body_bones"].reshape(-1, 4)
    weights = arrays["body_weights"].reshape(-1, 4) / 65535
    vertices = arrays["body_vertices"].reshape(-1, len(bones), 3)[shape] * meta["unit"]
    moved = np.einsum("vkab,vkb->vka", R[bones], vertices[:, None] - rest[bones]) + place[bones]
    return (weights[..., None] * moved).sum(axis=1)


def test_the_page_holds_the_bodys_vertices_within_a_millimetre(duet: Scene, body: Body) -> None:
    meta, arrays = contents(page(duet, body))
    truth = body.vertices(duet)[0].numpy()
    for frame, person in [(0, 0), (13, 1), (23, 0)]:
        assert np.abs(drawn(meta, arrays, person, frame) - truth[frame, person]).max() < 1e-3


def test_neighbouring_turns_lie_on_one_side_so_that_between_them_nobody_flips(body: Body) -> None:
    scene = random_scene(1, 200, 2, torch.Generator().manual_seed(3))
    _, arrays = contents(page(scene, body, styles=("skeleton",)))
    turns = arrays["turns"].reshape(200, 2, 22, 4).astype(float)
    assert ((turns[1:] * turns[:-1]).sum(-1) > 0).all()


def test_the_page_asks_for_nothing_from_elsewhere(duet: Scene, body: Body) -> None:
    text = page(duet, body)
    assert not re.findall(r"""(?:src|href)\s*=|https?:|//cdn|@import|fetch\(|XMLHttpRequest|import\(""", text)


def test_context_truth_and_title_are_there(duet: Scene, body: Body) -> None:
    meta, arrays = contents(page(duet, body, context=8, truth=duet.slice(0, 12), title="</script><b>"))
    assert [person["ghost"] for person in meta["people"]] == [False, False, True, True]
    known = arrays["known"].reshape(24, 4)
    assert known[:8, :2].all()
    assert not known[8:].any()
    assert "</script><b>" not in page(duet, body, title="</script><b>")


@pytest.mark.parametrize("title", ["x <!--<script> y", "a {{data}} b", "{{title}}"])
def test_a_title_may_hold_anything(title: str, duet: Scene, body: Body) -> None:
    plain, strange = (page(duet, body, title=each) for each in ("x", title))
    assert len(strange) < len(plain) + 1000
    assert "<!--<script>" not in strange
    assert contents(strange)[0]["takes"] == [title]


def test_the_page_marks_what_the_scene_says_was_given(duet: Scene, body: Body) -> None:
    given = torch.zeros(1, 24, 2, dtype=torch.bool)
    given[:, :, 1] = True
    _, arrays = contents(page(duet.replace(given=given), body, context=8))
    assert (arrays["known"].reshape(24, 2) == given[0].numpy()).all()


def test_two_people_for_six_seconds_take_less_than_two_megabytes(tmp_path: Path, body: Body) -> None:
    scene = random_scene(1, 182, 2, torch.Generator().manual_seed(3))
    assert save_html(scene, tmp_path / "scene", body, context=32).stat().st_size < 2e6


def test_a_licensed_bodys_skin_is_left_out_unless_it_is_asked_for(duet: Scene, body: Body) -> None:
    theirs = Body("smplx-neutral", *(getattr(body, name) for name in FIELDS))
    scene = duet.replace(body="smplx-neutral")
    meta, arrays = contents(page(scene, theirs))
    assert meta["styles"] == ["capsules", "skeleton"]
    assert not [name for name in arrays if name.startswith("body")]
    assert contents(page(scene, theirs, styles=("body",)))[0]["styles"] == ["body"]


def test_a_page_is_titled_by_the_names_of_what_it_shows(duet: Scene, body: Body, tmp_path: Path) -> None:
    def title(shown: Scene | list[ShownTake]) -> str:
        text = save_html(shown, tmp_path / "out.html", body, styles=("skeleton",)).read_text(encoding="utf-8")
        return re.search("<title>(.*?)</title>", text)[1]

    duet = duet.slice(0, 4).replace(names=())
    assert title(duet) == title(duet.repeat(2)) == "out"
    assert title(duet.replace(names=("60_04",))) == "60_04"
    assert title([take("a", duet), *takes(duet.repeat(2), "b"), take("a", duet)]) == "a, b"
    assert title([take(label, duet) for label in "abcde"]) == "a, b, c and 2 more"


FIELDS = ("J_template", "J_shapedirs", "v_template", "shapedirs", "weights", "faces")


def test_several_scenes_stand_side_by_side_and_share_their_meshes(duet: Scene, body: Body) -> None:
    given = torch.zeros(1, 24, 2, dtype=torch.bool)
    given[:, :8, 1] = True
    samples = duet.replace(given=given).repeat(3)
    meta, arrays = contents(page(samples, body, truth=duet.slice(0, 12), title="dance"))
    assert meta["takes"] == ["dance · 1", "dance · 2", "dance · 3"]
    assert [(person["take"], person["ghost"]) for person in meta["people"]] == [
        (take, ghost) for take in range(3) for ghost in (False, False, True, True)
    ]
    assert {person["shape"] for person in meta["people"]} == {0, 1}
    assert arrays["rest"].size == 2 * 22 * 3
    assert (arrays["known"].reshape(24, 3, 4)[:, :, :2] == given[0, :, None].numpy()).all()
    roots = arrays["roots"].reshape(24, 3, 4, 3)
    own = duet.T_world_root[0, :, :, :3, 3].numpy()
    shift = roots[:, :, :2] - own[:, None]
    np.testing.assert_allclose(shift, np.broadcast_to(shift[:1, :, :1], shift.shape), atol=1e-5)  # a place a take
    spans = [(roots[:, take, :2, 0].min(), roots[:, take, :2, 0].max()) for take in range(3)]
    assert spans[0][1] < spans[1][0] and spans[1][1] < spans[2][0]


def test_takes_of_several_lengths_and_people_share_a_page(duet: Scene, body: Body) -> None:
    short = duet.slice(0, 10).permute_agents(torch.tensor([1])).replace(given=torch.ones(1, 10, 1, dtype=torch.bool))
    meta, arrays = contents(page([take("long", duet), take("short", short)], body))
    assert (meta["frames"], [person["take"] for person in meta["people"]]) == (24, [0, 0, 1])
    turns = arrays["turns"].reshape(24, 3, 22, 4)
    assert (turns[9:, 2] == turns[9, 2]).all() and (turns[:10, 2] == turns[:10, 1]).all()
    with pytest.raises(ValueError, match=r"takes of \[30.0, 60.0\] frames a second"):
        page([take("a", duet), take("b", duet.replace(fps=60.0))], body)


def test_a_crowds_page_holds_light_bodies(body: Body) -> None:
    crowd = random_scene(3, 4, 3, torch.Generator().manual_seed(3))
    crowd = crowd.replace(betas=torch.zeros_like(crowd.betas))  # one mesh
    meta, arrays = contents(page(crowd, body))
    assert meta["styles"] == ["light", "capsules", "skeleton"]
    assert not [name for name in arrays if name.startswith("body")]


def test_a_page_is_an_html_file_and_nothing_else(duet: Scene, body: Body, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"a\.pdf: a page is a \.html file"):
        save_html(duet, tmp_path / "a.pdf", body)
    assert not list(tmp_path.iterdir())


def test_unknown_styles_are_refused(duet: Scene, body: Body) -> None:
    with pytest.raises(ValueError, match="choose from body, light, capsules, skeleton"):
        page(duet, body, styles=("cartoon",))  # type: ignore[arg-type]
