"""An agent among others, without network or clock: what it has heard, what it makes of it, and what it tells."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from magnet.agents.gate import AHEAD
from magnet.agents.message import JOINTS, LONGEST, POSE, TOKEN, Message
from magnet.agents.rollout import OwnRollout
from magnet.denoiser.core import DenoiserCore
from magnet.generation.loaded import Loaded, denoiser_of
from magnet.motion.frames import rigid
from magnet.motion.required import require_one, require_rate
from magnet.motion.rotations import from_quat, to_quat
from magnet.motion.scene import Scene, cat_time
from magnet.sampling.options import SamplerOptions
from magnet.seeding import step_generator
from magnet.tasks.agentic import AgenticAsync, AgenticSync

PAST = 8
"""Token steps that somebody who comes back goes on from, and that are told it."""
KEPT = 64
"""Token steps of everybody that are kept: what the tokenizer looks back at, and more."""
HELD = 18_000
"""Frames in a row, ten minutes, for which somebody who told none is held in a file, at most."""


@dataclass
class Piece:
    """A token of somebody, as far as it has come. poses (4, 91), of which those `there` (4,) have come."""

    poses: np.ndarray
    there: np.ndarray
    betas: tuple[float, ...]
    token: np.ndarray | None = None


def fingerprint(model: DenoiserCore) -> str:
    """Names a model's weights: tokens are understood by who has the same."""
    digest = hashlib.sha256()
    for name, value in model.state_dict().items():
        digest.update(name.encode() + value.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()[:16]


def poses_of(motion: Scene) -> np.ndarray:
    """One person's frames as a message has them. (1, T, 1) -> (T, 91)"""
    root, body = motion.T_world_root[0, :, 0].cpu(), motion.body_rot[0, :, 0].cpu()
    units = to_quat(torch.cat([root[:, None, :3, :3], body], dim=1))
    return torch.cat([root[:, :3, 3], units.flatten(1)], dim=1).float().numpy()


def motion_of(poses: np.ndarray, betas: Sequence[float]) -> Scene:
    """One person's frames. (T, 91) -> (1, T, 1)"""
    numbers = torch.from_numpy(np.array(poses, dtype=np.float32))
    units = torch.nn.functional.normalize(numbers[:, 3:].unflatten(1, (1 + JOINTS, 4)), dim=-1)
    rotations = from_quat(units)
    T_world_root = rigid(rotations[:, 0], numbers[:, :3])[None, :, None]
    shape = torch.tensor([[list(betas)]], dtype=torch.float32)
    return Scene(rotations[None, :, None, 1:], T_world_root, shape, torch.ones(1, 1, dtype=torch.bool))


def motion_told(told: Sequence[Message]) -> Scene:
    """One person's frames as messages told them, the first after the start scene first. -> (1, T, 1)

    Frames between them that nobody told, as where an agent joined later or went on where the others were, are held and
    not valid, so that files of several agents are of one time. Of more than `HELD` in a row the rest is left out: the
    others may have run for days, or say so by mistake.
    """
    made = cat_time([motion_of(each.poses, each.betas) for each in told])
    numbers = torch.tensor([each.frame + k for each in told for k in range(len(each.poses))])
    untold = numbers.diff(prepend=torch.tensor([-1])) - 1
    numbers -= (untold - HELD).clamp(min=0).cumsum(dim=0)
    frames = torch.arange(int(numbers[-1]) + 1)
    index = (torch.searchsorted(numbers, frames, right=True) - 1).clamp(min=0)
    there = numbers[index] == frames
    return made.frames_at(index).replace(valid=None if bool(there.all()) else there[None])


class Notebook:
    """What has been heard of everybody, token by token; 0 is the first token after the start scene.

    Args:
        start: one scene of everybody at 30 fps, of which the last whole tokens are used.
        names: of the agents, in the order of the scene's slots.
        me: one of them.

    Attributes:
        gaps: tokens of others that were missing when one's own was generated.
        filled: tokens that came later than they were wanted, and were filled in.

    Raises:
        ValueError: another number of names than of slots, a name twice, too long or empty, or no such agent.
    """

    def __init__(self, start: Scene, names: Sequence[str], me: str) -> None:
        self.gaps = self.filled = 0
        require_one(start)
        require_rate(start, "start")
        if len(names) != start.agents or len(set(names)) != len(names) or me not in names:
            raise ValueError(
                f"names: got {', '.join(names)} for {start.agents} slots and the agent {me}; expected a name for "
                "each slot, and the agent's among them"
            )
        if not all(1 <= len(name) <= LONGEST for name in names):
            raise ValueError(f"names: got {', '.join(map(repr, names))}, expected 1 to {LONGEST} letters each")
        self.names, self.me, self.next = tuple(names), tuple(names).index(me), 0
        whole = min(start.frames // TOKEN, KEPT // 2)
        self.start = start.slice(start.frames - whole * TOKEN).replace(valid=None, given=None, names=())
        self.pieces: list[dict[int, Piece]] = [{} for _ in names]
        for slot in range(start.agents):
            one = self.start.permute_agents(torch.tensor([slot]))
            for index in range(-whole, 0):
                part = one.slice((index + whole) * TOKEN, (index + whole + 1) * TOKEN)
                self.pieces[slot][index] = self.whole(poses_of(part), one.betas[0, 0].tolist())

    @staticmethod
    def whole(poses: np.ndarray, betas: Sequence[float], token: np.ndarray | None = None) -> Piece:
        return Piece(poses, np.ones(TOKEN, bool), tuple(betas), token)

    def hear(self, message: Message) -> None:
        """Note frames; those of a token that has come in parts are put together."""
        slot, (index, first) = self.names.index(message.agent), divmod(message.frame, TOKEN)
        pieces = self.pieces[slot]
        if index < self.next - KEPT:
            return
        self._make_room(pieces, index)
        blank = Piece(np.zeros((TOKEN, POSE), np.float32), np.zeros(TOKEN, bool), message.betas)
        piece = pieces.setdefault(index, blank)
        if piece.there.all() and piece.token is not None:
            return
        piece.poses[first : first + len(message.poses)] = message.poses
        piece.there[first : first + len(message.poses)] = True
        piece.token, piece.betas = message.token, message.betas

    @staticmethod
    def _make_room(pieces: dict[int, Piece], index: int) -> None:
        """Let go of what somebody who is at this token now told of far ahead, and of too much what was heard first.

        A token that has come whole stays: the nearest, by which one knows where they are.
        """
        whole = [each for each, piece in pieces.items() if piece.there.all()]
        kept = max((each for each in whole if each <= index), default=min(whole, default=index))
        for each in [each for each in pieces if each > index + AHEAD // TOKEN and each != kept]:
            del pieces[each]
        for each in [each for each in pieces if each != kept][: len(pieces) - 4 * KEPT]:
            del pieces[each]

    def come(self, slot: int, index: int) -> bool:
        """Whether a token has come whole."""
        return index in self.pieces[slot] and bool(self.pieces[slot][index].there.all())

    def last(self, slot: int) -> int:
        """The newest token that has come of somebody."""
        return max((index for index in self.pieces[slot] if self.come(slot, index)), default=-1)

    def newest(self) -> int:
        """The newest token that has come of anybody else."""
        return max(map(self.last, self.others()), default=-1)

    def others(self) -> list[int]:
        """The slots of everybody else who is in the start scene."""
        return [slot for slot in self.start.present[0].nonzero()[:, 0].tolist() if slot != self.me]

    def told(self, slot: int, index: int) -> Message:
        """A token as it is told, of oneself or of another."""
        piece, mine = self.pieces[slot][index], self.names[self.me]
        return Message("frames", self.names[slot], mine, 0, index * TOKEN, 0.0, piece.betas, piece.poses)

    def history(self, slot: int) -> Iterator[Message]:
        """The last tokens of oneself, and what one knows of somebody who has come back."""
        for of in (self.me, slot):
            known = sorted(index for index in self.pieces[of] if 0 <= index < self.next and self.come(of, index))
            yield from (self.told(of, index) for index in known[-PAST - 2 :])

    def forget(self) -> None:
        """Let go of what is not looked at again; where somebody was last is kept."""
        for slot, pieces in enumerate(self.pieces):
            last = max((index for index in pieces if self.come(slot, index)), default=None)
            for index in [index for index in pieces if index < self.next - KEPT and index != last]:
                del pieces[index]


class Agent(Notebook):
    """An agent that generates its own motion.

    Args:
        model: the trained denoiser, or what `magnet.load` returns, whose sampler is not read.
        start: see `Notebook`.
        names: see `Notebook`.
        me: see `Notebook`.
        task: in turns or in step, see `OwnRollout`.
        options: how to sample.
        seed: of the noise; the same for all who are to be as in one process.
    """

    def __init__(
        self,
        model: DenoiserCore | Loaded,
        start: Scene,
        names: Sequence[str],
        me: str,
        task: AgenticAsync | AgenticSync,
        options: SamplerOptions | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(start, names, me)
        self.model, self.task, self.options, self.seed = denoiser_of(model), task, options, seed
        order = task.order if isinstance(task, AgenticAsync) else ()
        turns = [*order, *(slot for slot in range(len(names)) if slot not in order)]
        in_turns = isinstance(task, AgenticAsync)
        self._before = {slot for slot in self.others() if in_turns and turns.index(slot) < turns.index(self.me)}
        self.print = fingerprint(self.model)
        self._wanted: set[tuple[int, int]] = set()
        self.begin()

    def begin(self) -> None:
        """Go on from the start scene."""
        generator = torch.Generator(device=self.model.device).manual_seed(self.seed)
        self._go_on(self.start, -(self.start.frames // TOKEN), generator, None)

    def join(self, stop: int | None = None) -> None:
        """Go on from what the others have told; what is not known of oneself is held.

        stop: the next token; None: after the newest of anybody else.
        """
        stop = self.newest() + 1 if stop is None else stop
        missing = torch.zeros(PAST, len(self.names), dtype=torch.bool)
        people = []
        for slot in range(len(self.names)):
            known = sorted(index for index in self.pieces[slot] if self.come(slot, index))
            parts = []
            for row, index in enumerate(range(stop - PAST, stop)):
                near = max((each for each in known if each <= index), default=known[0])
                piece = self.pieces[slot][near]
                missing[row, slot] = index not in known
                poses = piece.poses if index in known else np.repeat(piece.poses[-1:], TOKEN, axis=0)
                if slot == self.me:
                    self.pieces[slot][index] = self.whole(poses, piece.betas)
                parts.append(motion_of(poses, piece.betas))
            people.append(cat_time(parts))
        past = self.start.replace(
            body_rot=torch.cat([each.body_rot for each in people], dim=2),
            T_world_root=torch.cat([each.T_world_root for each in people], dim=2),
        )
        past = past.replace(present=self.start.present.clone())
        self._go_on(past, stop - PAST, step_generator(self.model.device, "agent", self.seed, stop), missing)

    def _go_on(self, past: Scene, base: int, generator: torch.Generator, missing: Tensor | None) -> None:
        self._base = base
        self.rollout = OwnRollout(self.model, past, self.me, self.task, self.options, generator, missing)
        self.next = base + self.rollout.row

    def limit(self, slot: int) -> int:
        """The newest token of somebody that the next own one may see."""
        return self.next if slot in self._before else self.next - 1

    def awaited(self) -> list[int]:
        """Who is there and has not told what the next token is to see."""
        there = self.rollout.world.given.present[0]
        return [slot for slot in self.others() if bool(there[slot]) and not self.come(slot, self.limit(slot))]

    def step(self) -> Message:
        """Generate the next token from what has come. Returns what is to be told."""
        self._enter()
        made = self.rollout.advance()
        poses, betas = poses_of(made.motion), tuple(made.motion.betas[0, 0].tolist())
        token = torch.cat([made.latent, made.T_world_can.flatten()]).cpu().numpy()
        index = self.next
        self.pieces[self.me][index] = self.whole(poses, betas, token)
        self.next += 1
        self.forget()
        return replace(self.told(self.me, index), model=self.print, token=token)

    def told(self, slot: int, index: int) -> Message:
        message, token = super().told(slot, index), self.pieces[slot][index].token
        return message if token is None or slot != self.me else replace(message, model=self.print, token=token)

    def _enter(self) -> None:
        """Tell the rollout what has come since, and who is there."""
        rollout = self.rollout
        for slot in self.others():
            for index in range(max(self.next - rollout.model.window, self._base), self.limit(slot) + 1):
                row = index - self._base
                if rollout.has(row, slot):
                    continue
                if not self.come(slot, index):
                    self.gaps += index == self.limit(slot)
                    self._wanted.add((slot, index))
                    continue
                piece = self.pieces[slot][index]
                motion = None if rollout.world.settle is None else motion_of(piece.poses, piece.betas)
                if rollout.fill(row, slot, *self._token(slot, index, piece), motion):
                    self.filled += (slot, index) in self._wanted
            placed = rollout.world.placed[max(rollout.row - rollout.model.window - rollout.first, 0) :, slot]
            rollout.be_there(slot, bool(self.start.present[0, slot]) and bool(placed.any()))
        self._wanted = {(slot, index) for slot, index in self._wanted if index >= self.next - rollout.model.window}

    def _token(self, slot: int, index: int, piece: Piece) -> tuple[Tensor, Tensor]:
        """Canonical frames and latent, as they were told, or of the poses where none were."""
        if piece.token is not None:
            numbers = torch.from_numpy(np.array(piece.token))
            return numbers[-TOKEN * 16 :].view(TOKEN, 4, 4), numbers[: -TOKEN * 16]
        first = index
        while self.come(slot, first - 1) and index - first < KEPT:
            first -= 1
        run = [motion_of(self.pieces[slot][i].poses, piece.betas) for i in range(first, index + 1)]
        return self.rollout.canonical(run[-1]), self.rollout.encode(run)


class Player(Notebook):
    """A recording that is played as if it happened: it stands for somebody in a headset or before a camera.

    Args:
        recording: one person (1, T, 1) at 30 fps, in the world of the start scene, from its end on.
        start: see `Notebook`.
        names: see `Notebook`.
        me: see `Notebook`.
    """

    def __init__(self, recording: Scene, start: Scene, names: Sequence[str], me: str) -> None:
        super().__init__(start, names, me)
        require_rate(recording, "recording")
        self.recording = recording

    def begin(self) -> None:
        """Play from the first frame."""
        self.next = 0

    def join(self, stop: int | None = None) -> None:
        """Play from where the others are. stop: see `Agent`"""
        self.next = self.newest() + 1 if stop is None else stop

    def awaited(self) -> list[int]:
        return []

    def step(self) -> Message | None:
        """The next frames; None: it is over."""
        part = self.recording.slice(self.next * TOKEN, (self.next + 1) * TOKEN)
        if part.frames < TOKEN:
            return None
        index = self.next
        self.pieces[self.me][index] = self.whole(poses_of(part), part.betas[0, 0].tolist())
        self.next += 1
        self.forget()
        return self.told(self.me, index)


Member = Agent | Player
"""Whoever takes part."""
