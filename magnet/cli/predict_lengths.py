"""How much `magnet predict FILE...` reads of files, how much of it is given of everybody, and how much is sampled."""

from __future__ import annotations

import argparse
import functools

from torch import Tensor

from magnet.api import Model
from magnet.cli.errors import CommandError
from magnet.cli.scene_files import CONTEXT, FUTURE
from magnet.cli.tasks import TaskChoice
from magnet.generation.plan import plan_of_scene
from magnet.motion.scene import FPS, Scene
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.schedule import MaskSchedule
from magnet.tasks.base import Task
from magnet.tasks.inbetweening import Inbetweening


def lengths(
    options: argparse.Namespace, choice: TaskChoice, scene: Scene, added: tuple[int, ...], model: Model
) -> tuple[Scene, int, int]:
    """What is read of the files, its frames that are given of everybody, and frames after them.

    A task that reads nothing of the recording after its context goes on from the end, so that nothing is thrown away.
    """
    crowd = scene.agents > model.most_people and choice.name != "generation"
    nothing = bool(added) or not (options.inputs or crowd)
    recorded = scene.frames // TOKEN_FRAMES * TOKEN_FRAMES if options.inputs or crowd else 0
    planned = functools.partial(plan_of_scene, model.denoiser, choice.task, scene.agents, options=model.sampler)
    context = context_of(options, scene.frames, recorded, nothing)
    if options.context is None and context:
        beyond = max(scene.frames - context, options.frames or FUTURE)
        context = fitting(context, choice.task, recorded, planned(context, beyond))
    elif within := [step for step in keys_of(choice.task, recorded) if 0 <= step * TOKEN_FRAMES < context]:
        print(f"--context {context}: in it lie the keyframes at token steps {', '.join(map(str, within))}")
    rest = options.frames or (scene.frames - context if recorded > context else 0) or FUTURE
    if added:  # planned with a past, for tasks that need one refuse to be planned without
        longer = planned(max(context, TOKEN_FRAMES), rest + min(context, TOKEN_FRAMES))
        if bool(longer.known[:, list(added)].any()):
            raise CommandError(
                f"{choice.name} reads motion of person {added[0]}, of whom no file tells; partner_inpainting adds "
                "people to those that are there, generation makes everybody"
            )
    known = planned(context, rest).known
    if bool(known[context // TOKEN_FRAMES :].any()):
        if context + rest > scene.frames:
            require_recorded(choice.name, context, recorded, known, crowd)
        return scene, context, rest
    if bool(known.any()):
        scene, context = going_on(options, choice.name, scene, context, recorded)
    else:  # as of generation, to which a context would be frames of nothing
        context = 0
        if options.inputs:
            print(f"{choice.name} is given no motion: of the files only the number and shapes of people are read")
    return scene, context, options.frames or FUTURE


def context_of(options: argparse.Namespace, frames: int, recorded: int, nothing: bool) -> int:
    """Frames that are given of everybody, in whole tokens, where the task reads what comes after them.

    frames: of the files, `recorded` of them in whole tokens; nothing: what is not said is 0, for somebody is made from
    nothing.
    """
    if options.inputs and not recorded:
        raise CommandError(f"the files hold {frames} frames at {FPS:g} a second; a token needs {TOKEN_FRAMES}")
    context: int | None = options.context
    if context is None:
        return 0 if nothing else min(CONTEXT, recorded)
    if 0 < context < TOKEN_FRAMES:
        raise CommandError(f"--context {context}: a token is {TOKEN_FRAMES} frames; give as many or more, or 0")
    whole = context // TOKEN_FRAMES * TOKEN_FRAMES
    if whole > recorded or context > frames:
        raise CommandError(f"--context {context}: the files hold {recorded} frames in whole tokens; give fewer")
    if whole < context:
        print(f"--context {context}: {whole} are given, in tokens of {TOKEN_FRAMES} frames")
    return whole


def fitting(context: int, task: Task, recorded: int, plan: MaskSchedule) -> int:
    """Frames given of everybody where nothing is said: fewer than `context` where the task could not do with so many.

    None where it is not given everybody's past, those before the first keyframe where there are keyframes, and half of
    what is recorded, in whole tokens, where the task reads what comes after them and that would be nothing.

    Args:
        context: frames, in whole tokens.
        task: what is sampled.
        recorded: frames of the files, in whole tokens.
        plan: of the task with this context, and with more frames after it than are recorded, or asked for.
    """
    known, tokens, last = plan.known, context // TOKEN_FRAMES, recorded // TOKEN_FRAMES
    if not bool(known[:tokens].all()):
        return 0
    if keys := keys_of(task, recorded):
        return min(tokens, *keys) * TOKEN_FRAMES
    return (last // 2 if tokens == last and bool(known[tokens:].any()) else tokens) * TOKEN_FRAMES


def keys_of(task: Task, recorded: int) -> list[int]:
    """Token steps of the keyframes that a task names, in so many recorded frames."""
    return task.named(recorded // TOKEN_FRAMES) if isinstance(task, Inbetweening) else []


def require_recorded(task: str, context: int, recorded: int, known: Tensor, crowd: bool) -> None:
    """Refuse a task that reads more than is recorded. known (N, P) bool"""
    needed = (int(known.any(dim=1).nonzero()[-1]) + 1) * TOKEN_FRAMES
    if needed <= recorded:
        return
    if crowd:
        raise CommandError(
            f"{task} reads what comes after the {context} frames that a crowd begins with, and of a crowd nothing is "
            "recorded there; a task that goes on from a past does, such as joint_future"
        )
    if recorded <= context:
        raise CommandError(
            f"--context {context}: leaves none of the {recorded} recorded frames (in whole tokens) that {task} reads "
            "after them; give fewer"
        )
    raise CommandError(
        f"{task} reads {needed} frames, {context} given of everybody and {needed - context} after them; {recorded} are "
        f"recorded (in whole tokens), so give --frames {recorded - context} or fewer"
    )


def going_on(options: argparse.Namespace, task: str, scene: Scene, context: int, recorded: int) -> tuple[Scene, int]:
    """What a task goes on from that reads nothing after its context: all of the files, unless --context says less."""
    if options.context is None and recorded:
        return scene.slice(scene.frames - recorded), recorded
    if scene.frames > context and options.inputs:
        unread = f"{scene.frames - context} of {scene.frames} recorded frames come after it and are not read"
        print(f"--context {context}: {unread}; without it {task} goes on from the end")
    return scene, context
