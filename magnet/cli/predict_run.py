"""`magnet predict FILE...` once its command line is understood: what is read, sampled and written."""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from jsonargparse import ArgumentParser

from magnet.api import Model, Motion
from magnet.body import Body, load_body
from magnet.cli import predict_keys, predict_written, scene_files
from magnet.cli.config_files import sampler_preset
from magnet.cli.errors import CommandError
from magnet.cli.flags import flat
from magnet.cli.kept_checkpoints import checkpoint_of
from magnet.cli.predict_lengths import lengths
from magnet.cli.scene_files import CONTEXT
from magnet.cli.tasks import TaskChoice, parse_task, read_fields, task_class
from magnet.denoiser.core import DenoiserCore
from magnet.export import formats
from magnet.generation.crowd_start import crowd_from_nothing
from magnet.generation.plan import plan_of_scene
from magnet.generation.unmade import completed
from magnet.motion.scene import FPS, Scene, empty_scene
from magnet.motion.tokens import TOKEN_FRAMES
from magnet.sampling.guidance import Guidance
from magnet.sampling.options import SamplerOptions


def run(options: argparse.Namespace, fields: Mapping[str, list[str]], outs: Sequence[Path]) -> int:
    """Read, sample and write. Returns the exit code.

    fields: flags of the options of the `task` and of the `sampler`
    """
    sampler = sampler_of(options.sampler or "default", fields["sampler"])
    if options.spacing is not None:
        sampler = dataclasses.replace(sampler, crowd_spacing=options.spacing)
    recorded, body = read_files(options)  # before the model is loaded, so that what is not there is said at once
    people = people_written(options, recorded)
    for out in outs:
        scene_files.require_unread(out, options.inputs, people)
    if options.task not in (None, "generation"):  # of a crowd these are said later: it may change the task
        task_of(options, fields["task"], ())
    model = Model(DenoiserCore.load(checkpoint_of(options.ckpt_path)), sampler)
    scene, added = people_of(options, recorded, model)
    task = task_of(options, fields["task"], added)
    files, (scene, context, frames) = scene, lengths(options, task, scene, added, model)
    files, lead = predict_written.in_front(files, scene)
    plan = plan_of_scene(model.denoiser, task.task, scene.agents, context, frames, sampler)
    unmade = ~plan.finished
    scene_files.say_other_body(model.denoiser, recorded.body)
    for line in (
        *predict_written.said_of_invalid(scene, plan.known, lead),
        *predict_keys.said_of_keys(scene, plan.known, context // TOKEN_FRAMES),
        *predict_written.said_of_unmade(task.name, files, lead, context + frames, unmade),
    ):
        print(line)
    began = time.perf_counter()
    moved = Motion.of(scene, body)
    made = model.sample(moved, task.task, context, frames, seed=options.seed, samples=options.samples)
    count, seen = made.scenes * (lead + made.frames), predict_written.said_of_given(made, lead)
    print(f"{task.name}: {count} frames{seen} in {time.perf_counter() - began:.1f} s, seed {options.seed}")
    given, plain = lead + made.context, completed(made.plain(), files, plan.known, unmade, lead)
    if plain.scenes > 1 and scene.scenes == 1:
        plain = plain.replace(names=tuple(f"sample {number + 1}" for number in range(plain.scenes)))
    for out in outs:
        look = {"style": options.style, "size": tuple(options.size), "context_frames": given}
        scene_files.say_written(formats.write(plain, out, body, progress=True, **look))
    return 0


def read_files(options: argparse.Namespace) -> tuple[Scene, Body]:
    """The people of all files, or a scene of nobody, and its body."""
    if options.inputs:
        got = scene_files.read_inputs(options, scene_files.reading(options, FPS))
        return got.scene, got.body
    body = load_body(options.body or "open")
    return empty_scene(1, TOKEN_FRAMES, 0, torch.zeros(())).replace(body=body.id), body


def people_written(options: argparse.Namespace, scene: Scene) -> list[int]:
    """How many people are there in each scene that will be written."""
    people = scene.agents if options.people is None else options.people
    if people < max(scene.agents, 1):
        raise CommandError(f"--people {people}: expected at least {max(scene.agents, 1)}, as many as IN holds")
    there: list[int] = scene.present.sum(dim=1).tolist()
    return [count + people - scene.agents for count in there for _ in range(options.samples)]


def people_of(options: argparse.Namespace, scene: Scene, model: Model) -> tuple[Scene, tuple[int, ...]]:
    """The scene of all files with room for those who are made from nothing, and the slots of these.

    A crowd is composed of the files' people, again and again, or of couples that the model makes.
    """
    people = scene.agents if options.people is None else options.people
    if people > max(model.most_people, scene.agents):
        if not options.inputs and not options.context and options.task in (None, "generation"):
            return crowd_from_nothing(people, torch.Generator().manual_seed(options.seed)), ()
        if options.context == 0:
            raise CommandError(
                f"--context 0: a crowd goes on from frames of everybody; it begins with {CONTEXT} by itself"
            )
        groups = [start_of_crowd(options, scene)] if options.inputs else []
        options.context = options.context or (groups[0].frames if groups else CONTEXT)
        return model.start_crowd(people, groups, model.sampler.crowd_spacing, seed=options.seed), ()
    if options.spacing is not None:
        raise CommandError(
            f"--spacing {options.spacing:g}: places the groups of a crowd, which begins above {model.most_people} "
            "people; leave it out"
        )
    added = tuple(range(scene.agents, people))
    scene = scene.pad_agents(people)
    present = scene.present.clone()
    present[:, list(added)] = True
    return scene.replace(present=present), added


def start_of_crowd(options: argparse.Namespace, scene: Scene) -> Scene:
    """The frames of the files that a crowd begins with: the first --context, or without it the last `CONTEXT`."""
    if options.context is not None:
        return scene.slice(0, options.context)
    if scene.frames > CONTEXT:
        print(f"the crowd begins with the last {CONTEXT} of {scene.frames} frames (--context T: with the first T)")
    return scene.slice(max(scene.frames - CONTEXT, 0))


def task_of(options: argparse.Namespace, flags: list[str], added: tuple[int, ...]) -> TaskChoice:
    """The task; where people are added and it is for some of the people, it is for these."""
    name = options.task or ("joint_future" if options.inputs or options.context else "generation")
    fields = {each.name for each in dataclasses.fields(task_class(name))}
    below = [{"target": list(added)}] if added and "target" in fields else []
    return parse_task(name, flags, below, "predict")


def sampler_of(preset: str, flags: list[str]) -> SamplerOptions:
    """How to sample."""
    known = ArgumentParser(exit_on_error=False)
    known.add_class_arguments(SamplerOptions, "sampler")
    known.set_defaults(flat({"sampler": sampler_preset(preset)}))
    fields = read_fields(known, flags, (), "magnet predict --help sampler")["sampler"]
    return SamplerOptions(**{**fields, "guidance": Guidance(**fields["guidance"])})
