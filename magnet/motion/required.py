"""What a scene must be for whoever takes it: of the models' frame rate, of one body, one scene."""

from magnet.motion.scene import FPS, Scene


def require_rate(scene: Scene, label: str = "the scene") -> None:
    """Refuse a scene of another frame rate than the models'.

    Raises:
        ValueError: it has another; says how to bring it there.
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"{label}: got {type(scene).__name__}, expected a Scene; magnet.read(path) reads one")
    if abs(scene.fps - FPS) > 1e-3:
        raise ValueError(
            f"{label} runs at {scene.fps:g} fps, the model at {FPS:g}: bring it there with magnet export IN.npz OUT.npz"
            f" --fps {FPS:g}, magnet.export.resampled(scene, {FPS:g}) or, live, pose by pose, magnet.export.LiveFrames"
        )


def require_body(scene: Scene, body: str) -> None:
    """Refuse a scene whose shape numbers belong to another body.

    Raises:
        ValueError: they do; names both.
    """
    if scene.body != body:
        raise ValueError(f"the scene belongs to body {scene.body!r}, but {body!r} was given")


def require_one(scene: Scene) -> None:
    """Refuse a batch of several scenes, or of none.

    Raises:
        ValueError: B is not 1; says how to take one.
    """
    if scene.scenes != 1:
        raise ValueError(f"got {scene.scenes} scenes, expected one; take each scene.select([b]) by itself")
