"""Moving pictures: who is where, in which colour, and what is in the file."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from magnet.body import Body
from magnet.export import Camera, render_video
from magnet.export.drawing import (
    AGENTS,
    CONTEXT,
    SMALLEST,
    STYLES,
    Canvas,
    Size,
    Style,
    plan_views,
    require_size,
    strokes,
)
from magnet.export.video import Film, stamp
from magnet.extras import installing
from magnet.motion.scene import Scene
from magnet.testing import random_scene
from tests.cases import some_slow

Count = Callable[[Image.Image, tuple[int, int, int]], int]
SMALL = (160, 120)


def film(scenes: object, body: Body, context: int = 4, style: Style = "skeleton", **kw) -> Film:  # type: ignore[no-untyped-def]
    options = {"fps": 30.0, "size": SMALL, "title": None, "ghosts": None, "camera": Camera(), "trail": 0.0} | kw
    return Film(scenes, context, body, style, **options)  # type: ignore[arg-type]


def frames_of(path: Path) -> list[Image.Image]:
    if path.suffix == ".mp4":
        av = pytest.importorskip("av", reason="PyAV is not installed")
        with av.open(str(path)) as container:
            return [frame.to_image() for frame in container.decode(video=0)]
    with Image.open(path) as file:
        images = []
        for index in range(file.n_frames):
            file.seek(index)
            images.append(file.convert("RGB"))
        return images


def test_the_clock_of_a_film_has_no_minus_nothing() -> None:
    assert [stamp(seconds, True) for seconds in (-1.26, -0.033, 0.0, 0.04, 2.0)] == [
        "-1.3 s",
        "+0.0 s",
        "+0.0 s",
        "+0.0 s",
        "+2.0 s",
    ]
    assert stamp(2.0, False) == "2.0 s"


@pytest.mark.parametrize("suffix", [".mp4", ".gif", ".webp"])
@pytest.mark.parametrize(("fps", "expected"), [(30.0, 12), (15.0, 6)])
def test_a_file_holds_the_scenes_seconds_at_the_fps_asked_for(
    suffix: str, fps: float, expected: int, duet: Scene, body: Body, tmp_path: Path, pixels_like: Count
) -> None:
    if suffix == ".mp4":
        pytest.importorskip("av", reason="PyAV is not installed")
    path = render_video(duet, tmp_path / f"duet{suffix}", context_frames=4, body=body, fps=fps, size=SMALL)
    images = frames_of(path)
    assert len(images) == expected
    assert all(image.size == SMALL for image in images)
    assert pixels_like(images[0], CONTEXT[0]) > 30
    assert pixels_like(images[-1], AGENTS[0]) > 30
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("size", [(SMALLEST, SMALLEST), (28, 28), (640, SMALLEST), (SMALLEST, 640)])
def test_panels_of_every_size_that_is_not_refused_are_drawn(size: Size, duet: Scene, body: Body) -> None:
    require_size(size)
    assert film(duet, body, size=size).draw(0).size == size


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
@pytest.mark.parametrize("fps", [30.0, 60.0, 120.0, 240.0])
def test_a_fast_scene_lasts_as_long_as_it_does_and_no_frame_is_too_short_for_browsers(
    suffix: str, fps: float, body: Body, tmp_path: Path
) -> None:
    scene = random_scene(1, round(0.6 * fps) + 1, 1, torch.Generator().manual_seed(1)).replace(fps=fps)
    path = render_video(scene, tmp_path / f"a{suffix}", context_frames=0, body=body, fps=fps, size=(64, 48))
    lasting = []
    with Image.open(path) as file:
        for index in range(file.n_frames):
            file.seek(index)
            file.load()
            lasting.append(file.info["duration"])
    assert min(lasting) >= 20
    assert sum(lasting) == pytest.approx(1000 * scene.frames / fps, abs=10 if suffix == ".gif" else 1)


@pytest.mark.parametrize("style", some_slow(STYLES, "light"))
def test_known_frames_are_pink_and_generated_ones_are_not(
    style: Style, duet: Scene, body: Body, pixels_like: Count
) -> None:
    movie = film(duet, body, style=style)
    known, generated = movie.draw(3).crop((0, 0, 160, 95)), movie.draw(4).crop((0, 0, 160, 95))  # without time bar
    assert pixels_like(known, CONTEXT[0]) > 100
    assert pixels_like(generated, CONTEXT[0]) == 0
    for colour in AGENTS[:2]:
        assert pixels_like(generated, colour) > 60
        assert pixels_like(known, colour) == 0


def test_the_time_bar_tells_keyframes_which_are_given_too(duet: Scene, body: Body, pixels_like: Count) -> None:
    given = torch.zeros(1, 12, 2, dtype=torch.bool)
    given[:, :4], given[:, 8], given[:, 10, 0] = True, True, True
    movie = film(duet.replace(given=given), body)
    pink = [pixels_like(movie.draw(frame).crop((0, 95, 160, 120)), CONTEXT[0]) for frame in (7, 8, 10)]
    assert pink[1] > pink[0] + 10 and pink[2] == pink[0], "only where everybody is given"


def test_a_mask_can_give_one_person_only(duet: Scene, body: Body, pixels_like: Count) -> None:
    given = torch.tensor([[False, True]]).expand(1, 12, 2)
    image = film(duet.replace(given=given), body).draw(11)
    assert pixels_like(image, CONTEXT[1]) > 60
    assert pixels_like(image, AGENTS[0]) > 60
    assert pixels_like(image, AGENTS[1]) == 0


@pytest.mark.parametrize("people", [1, 2, 4])
def test_everybody_stays_in_the_picture_and_the_camera_is_calm(people: int, body: Body) -> None:
    scene = random_scene(1, 90, people, torch.Generator().manual_seed(people))
    joints = body.joints(scene)[0].double().numpy()
    views = plan_views([joints], Camera(), (640, 480), 30.0)[0]
    for view, moment in zip(views, joints, strict=True):
        pixels, depth = view.project(moment)
        assert (depth > 0.5).all()
        assert (pixels > 0).all() and (pixels < [640, 480]).all()
    step = np.abs(np.diff([view.distance for view in views])).max()
    assert step < 0.2, f"the camera jumps {step:.2f} m in a frame"


def test_what_starts_alike_is_seen_alike(duet: Scene, body: Body) -> None:
    joints = body.joints(duet)[0].double().numpy()
    later = joints.copy()
    later[6:] += [0.4, 0.0, 0.3]
    a, b = plan_views([joints, later], Camera(), SMALL, 30.0)
    assert all((x.axes == y.axes).all() and x.distance == y.distance for x, y in zip(a, b, strict=True))


def test_a_camera_projects_as_a_pinhole(duet: Scene, body: Body) -> None:
    """The pixel is where the ray from the eye through the point meets the picture plane."""
    joints = body.joints(duet)[0].double().numpy()
    view = plan_views([joints], Camera(azimuth=0.7, elevation=0.4), SMALL, 30.0)[0][0]
    pixels, depth = view.project(joints[0])
    ray = joints[0] - view.eye
    right, up, away = view.axes
    assert np.allclose(np.cross(right, up), -away)
    assert np.allclose(depth, ray @ away)
    assert np.allclose(pixels[..., 0], 80 + view.focal * (ray @ right) / (ray @ away))
    assert np.allclose(pixels[..., 1], 60 - view.focal * (ray @ up) / (ray @ away))
    assert view.eye[1] > 1.0 and view.eye[2] > view.centre[2]


def test_near_polygons_hide_far_ones(duet: Scene, body: Body) -> None:
    view = plan_views([body.joints(duet)[0].double().numpy()], Camera(), SMALL, 30.0)[0][0]
    square = np.array([[[10.0, 10], [30, 10], [30, 30], [10, 30]]])
    for order in ((0, 1), (1, 0)):
        canvas = Canvas(view)
        for i in order:
            canvas.add(square, np.array([[(255, 0, 0), (0, 0, 255)][i]]), np.array([1.0 + i]))
        canvas.paint()
        assert canvas.image.getpixel((20, 20)) == (255, 0, 0)


def test_strokes_are_hulls_of_two_circles() -> None:
    spatial = pytest.importorskip("scipy.spatial", reason="scipy is not installed")
    generator = np.random.default_rng(0)
    start, end = generator.uniform(0, 50, (20, 2)), generator.uniform(0, 50, (20, 2))
    radius = generator.uniform(1, 8, (2, 20))
    outlines = strokes(start, end, radius[0], radius[1], corners=200)
    angle = np.linspace(0, 2 * np.pi, 400)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    for i, outline in enumerate(outlines):
        points = np.concatenate([start[i] + radius[0, i] * circle, end[i] + radius[1, i] * circle])
        x, y = outline.T
        area = abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2
        assert area == pytest.approx(spatial.ConvexHull(points).volume, rel=2e-3)


def test_absent_people_change_nothing(duet: Scene, body: Body) -> None:
    assert film(duet.pad_agents(4), body).draw(6).tobytes() == film(duet, body).draw(6).tobytes()


def test_panels_stand_side_by_side_with_ghosts_behind(duet: Scene, body: Body, pixels_like: Count) -> None:
    movie = film([("one", duet), ("two", duet), ("three", duet)], body, title="three", ghosts=duet)
    image = movie.draw(8)
    assert image.size == movie.size_all == (480, 130)
    for i in range(3):
        panel = image.crop((160 * i, 10, 160 * i + 160, 110))
        assert pixels_like(panel, AGENTS[0]) > 60 and pixels_like(panel, AGENTS[1]) > 60
    moved = duet.transformed(torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -1.0], [0, 0, 0, 1]]))
    assert film(duet, body, ghosts=moved).draw(8).tobytes() != film(duet, body, ghosts=duet).draw(8).tobytes()


def test_progress_is_told_after_each_frame(duet: Scene, body: Body, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    path = tmp_path / "a.gif"
    render_video(duet, path, context_frames=4, body=body, size=SMALL, progress=lambda *at: told.append(at))
    assert told == [(i + 1, 12) for i in range(12)]
    render_video(duet, path, context_frames=4, body=body, size=SMALL, progress=True)


def test_bad_input_is_named_and_leaves_no_file(duet: Scene, body: Body, tmp_path: Path) -> None:
    def render(scene: Scene | dict[str, Scene] = duet, name: str = "a.gif", context: int = 4, **kw) -> None:  # type: ignore[no-untyped-def]
        render_video(scene, tmp_path / name, context_frames=context, body=body, **({"size": SMALL} | kw))

    with pytest.raises(ValueError, match=r"\.avi.*\.mp4, \.gif, \.webp"):
        render(name="a.avi")
    with pytest.raises(ValueError, match="even"):
        render(size=(161, 120))
    with pytest.raises(ValueError, match="fps: got 0, expected more than 0"):
        render(fps=0.0)
    with pytest.raises(ValueError, match="expected one of body"):
        render(style="bones")
    with pytest.raises(ValueError, match="nobody is present"):
        render(duet.replace(present=torch.zeros(1, 2, dtype=torch.bool)))
    with pytest.raises(ValueError, match=r"context_frames: got 13, expected 0 to 12"):
        render(context=13)
    with pytest.raises(ValueError, match=r"\[11, 12\] frames"):
        render({"a": duet, "b": duet.slice(0, 11)})
    with pytest.raises(ValueError, match=r"\[30\.0, 60\.0\] frames a second, expected one rate"):
        render({"a": duet, "b": duet.replace(fps=60.0)})
    with pytest.raises(ValueError, match="ghosts have 11 frames"):
        render(ghosts=duet.slice(0, 11))
    T_world_root = duet.T_world_root.clone()
    T_world_root[0, 7, 1, 0, 3] = torch.nan
    with pytest.raises(ValueError, match=r"1 of 12 frames.*the first is frame 7"):
        render(duet.replace(T_world_root=T_world_root))

    def interrupt(done: int, total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render(progress=interrupt)
    assert list(tmp_path.iterdir()) == []


def test_mp4_without_pyav_names_the_fix(
    duet: Scene, body: Body, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ImportError, match=re.escape(installing("video"))):
        render_video(duet, tmp_path / "a.mp4", context_frames=4, body=body, size=SMALL)


def test_a_faster_picture_shows_all_of_the_scene_in_less_time(duet: Scene, body: Body, tmp_path: Path) -> None:
    with Image.open(render_video(duet, tmp_path / "a.gif", context_frames=0, body=body, size=(64, 48))) as film:
        slow = film.n_frames  # type: ignore[attr-defined]
    path = render_video(duet, tmp_path / "b.gif", context_frames=0, body=body, size=(64, 48), speed=4.0)
    with Image.open(path) as film:
        assert film.n_frames == round(slow / 4)  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="speed: got 0, expected more than 0"):
        render_video(duet, tmp_path / "c.gif", context_frames=0, body=body, speed=0.0)
