"""A codebook that follows its vectors by a moving average, in step over all processes (paper 3.1, Table A.2)."""

from __future__ import annotations

import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn import functional as F

from magnet.precision import Float32
from magnet.tokenizer.base import Quantized
from magnet.tokenizer.code_search import FEW, Book, nearest_codes

KMEANS_ROUNDS = 10
KMEANS_VECTORS = 8
"""Vectors for each code, over all processes, from which k-means starts; more only cost time."""

OFTEN = 8
"""After so many lookups of few vectors the codebooks are prepared for them (0.1 s at the shipped sizes)."""

CROWD = 4.0
"""With fewer vectors for each code in a batch, `dead_code_threshold` is lowered in proportion."""


class ResidualVQ(Float32):
    """Residual vector quantizer: each codebook quantizes the residual of the codebooks before it.

    Codes are buffers and get no gradient. In training mode an exponential moving average of the vectors assigned to
    a code updates it. In evaluation, or when `frozen`, codes stay. Counts and sums are reduced over processes, so every
    process holds the same bits. Whether there are several is asked at each call, because Lightning makes its process
    group after its modules.

    Args:
        codebook_size: codes in each codebook, paper Table A.2.
        codebook_dim: numbers in a code, paper Table A.2.
        num_quantizers: codebooks; 1 is the paper's single codebook.
        ema_decay: decay of the moving averages.
        dead_code_threshold: a code whose average count per batch falls below this is replaced by a vector of the batch.
            With fewer than 4 vectors per code in a batch the threshold is lowered in proportion; otherwise small
            batches would replace good codes (ours).
        waits: vectors are left as they are until there are codes.
    """

    unit_input = True
    codes: Tensor  # (quantizers, codes, D)
    ema_count: Tensor  # (quantizers, codes)
    ema_sum: Tensor  # (quantizers, codes, D)
    initialized: Tensor  # () bool

    def __init__(
        self,
        codebook_size: int = 1024,
        codebook_dim: int = 512,
        num_quantizers: int = 1,
        ema_decay: float = 0.99,
        dead_code_threshold: float = 1.0,
        waits: bool = False,
    ) -> None:
        super().__init__()
        self.waits = waits
        self.size, self.dim, self.num_quantizers = codebook_size, codebook_dim, num_quantizers
        self.ema_decay, self.dead_code_threshold = ema_decay, dead_code_threshold
        self.frozen = False
        self._lengths: tuple[tuple[int, int], Tensor] | None = None  # of codes, squared, while they stay
        self._searched: tuple[tuple[int, int], list[Book]] | None = None  # while codes stay
        self._lookups = 0  # of few vectors, since then
        self._started: tuple[tuple[int, int], bool] | None = None  # whether there are codes, while that stays
        self.register_buffer("codes", torch.zeros(num_quantizers, codebook_size, codebook_dim, dtype=torch.float32))
        self.register_buffer("ema_count", torch.ones(num_quantizers, codebook_size, dtype=torch.float32))
        self.register_buffer("ema_sum", torch.zeros(num_quantizers, codebook_size, codebook_dim, dtype=torch.float32))
        self.register_buffer("initialized", torch.tensor(False))

    # -- looking up ----------------------------------------------------------------------------

    def forward(
        self, vectors: Tensor, mask: Tensor | None = None, generator: torch.Generator | None = None
    ) -> Quantized:
        """Quantize; in training also update the codes.

        Args:
            vectors: (..., D), computed in float32 whatever the autocast.
            mask: (...) bool; False: quantized, but left out of updates, loss and counts.
            generator: draws the vectors that start and revive codes; only that of rank 0 counts.
        """
        with torch.autocast(vectors.device.type, enabled=False):
            flat = vectors.float().flatten(0, -2)
            if self.waiting:
                none = flat.new_full((*vectors.shape[:-1], self.num_quantizers), -1, dtype=torch.long)
                unused = flat.new_zeros(self.num_quantizers, self.size)
                return Quantized(flat.view(vectors.shape), none, flat.new_zeros(()), unused)
            keep = torch.ones_like(flat[:, 0], dtype=torch.bool) if mask is None else mask.flatten()
            update = self.training and not self.frozen
            if update and not self.started:
                self.kmeans_init(flat.detach()[keep], generator)
            residual, latent = flat, torch.zeros_like(flat)
            index, commitment, counts = [], flat.new_zeros(()), []
            for book in range(self.num_quantizers):
                chosen = self._nearest(residual.detach(), book)
                code = self.codes[book][chosen]
                distance = (residual - code).square().mean(-1)
                commitment = commitment + torch.where(keep, distance, 0.0).sum() / keep.sum().clamp(min=1)
                counts.append(self.ema_update(residual.detach(), chosen, keep, book, generator, update))
                index.append(torch.where(keep, chosen, -1))
                latent, residual = latent + code, residual - code
            if flat.requires_grad:
                latent = flat + (latent - flat).detach()
            return Quantized(
                latent=latent.view(vectors.shape),
                index=torch.stack(index, dim=-1).view(*vectors.shape[:-1], self.num_quantizers),
                commitment=commitment / self.num_quantizers,
                counts=torch.stack(counts),
            )

    @property
    def started(self) -> bool:
        """Whether there are codes."""
        if self.initialized.is_inference():
            return bool(self.initialized)
        now = (self.initialized.data_ptr(), self.initialized._version)
        if self._started is None or self._started[0] != now:  # a GPU would be waited for each time
            self._started = (now, bool(self.initialized))
        return self._started[1]

    @property
    def waiting(self) -> bool:
        """Whether vectors are left as they are, because there are no codes yet."""
        return self.waits and not self.started

    def continuous(self, vectors: Tensor) -> Tensor:
        """The vectors as they are, not quantized: codes lie in the same space."""
        return vectors.float()

    @torch.no_grad()
    def nearest(self, vectors: Tensor) -> Tensor:
        """The sum of the nearest codes, codebook by codebook; nothing is updated. (..., D) -> (..., D) float32"""
        if self.waiting:
            return self.continuous(vectors)
        with torch.autocast(vectors.device.type, enabled=False):
            residual = vectors.float().flatten(0, -2)
            if len(residual) <= FEW and (books := self.books()):
                return torch.from_numpy(nearest_codes(books, residual.detach().numpy())).view(vectors.shape)
            latent = torch.zeros_like(residual)
            for book in range(self.num_quantizers):
                code = self.codes[book][self._nearest(residual, book)]
                latent, residual = latent + code, residual - code
            return latent.view(vectors.shape)

    def _nearest(self, vectors: Tensor, book: int) -> Tensor:
        if self.training or self.codes.is_inference():
            return _nearest(vectors, self.codes[book])
        now = (self.codes.data_ptr(), self.codes._version)
        if self._lengths is None or self._lengths[0] != now:
            self._lengths = (now, self.codes.square().sum(-1))
        return (self._lengths[1][book] - 2 * vectors @ self.codes[book].T).argmin(-1)

    def books(self) -> list[Book]:
        """The codebooks as few vectors look them up; none before that has been asked for often."""
        if self.training or self.codes.device.type != "cpu" or self.codes.is_inference():
            return []
        now = (self.codes.data_ptr(), self.codes._version)
        kept = self._searched
        if kept is None or kept[0] != now:
            self._searched = kept = now, []
            self._lookups = 0
        self._lookups += 1
        if self._lookups >= OFTEN and not kept[1]:  # all of them at once: threads share a model
            self._searched = kept = now, [Book.of(codes) for codes in self.codes]
        return kept[1]

    # -- following -----------------------------------------------------------------------------

    @torch.no_grad()
    def ema_update(
        self, vectors: Tensor, chosen: Tensor, keep: Tensor, book: int, generator: torch.Generator | None, update: bool
    ) -> Tensor:
        """Count the vectors of each code, (codes,); in training also update the codes."""
        onto = F.one_hot(chosen, self.size).to(vectors.dtype) * keep[:, None]
        count = onto.sum(0)
        if not update:
            return count
        # As a matrix product and not a scatter, which would add in another order each time on a GPU.
        total = onto.T @ torch.where(keep[:, None], vectors, 0.0)
        summed = sum_over_processes(torch.cat([count[:, None], total], dim=1))
        count, total = summed[:, 0], summed[:, 1:]
        several = count.sum()
        decay = torch.where(several > 0, self.ema_decay, 1.0)
        ema_count = decay * self.ema_count[book] + (1 - decay) * count
        ema_sum = decay * self.ema_sum[book] + (1 - decay) * total

        least = self.dead_code_threshold * (several / (CROWD * self.size)).clamp(max=1.0)
        dead = ema_count < least
        fresh = self._picks(vectors, keep, generator)
        # Just enough weight to stay if the coming batches choose it.
        ema_count = torch.where(dead, least, ema_count)
        ema_sum = torch.where(dead[:, None], least * fresh, ema_sum)
        # A code that nobody chose stays where it is to the bit.
        codes = torch.where((count > 0)[:, None], ema_sum / ema_count[:, None], self.codes[book])
        codes = torch.where(dead[:, None], fresh, codes)
        self.ema_count[book], self.ema_sum[book], self.codes[book] = ema_count, ema_sum, codes
        return count

    def _picks(self, vectors: Tensor, keep: Tensor, generator: torch.Generator | None) -> Tensor:
        """Draw an unmasked vector of any process for each code, the same in every process. (codes, D)"""
        draws = _rand(self.size, vectors.device, generator)
        mine = keep.sum()
        before, everyone = _before_mine(mine)
        pick = torch.minimum((draws * everyone).long(), everyone - 1) - before
        ours = (pick >= 0) & (pick < mine)
        # Kept vectors first, in their order, so that a pick is an index among them.
        order = torch.argsort((~keep).to(torch.uint8), stable=True)
        fresh = vectors[order[pick.clamp(min=0, max=len(order) - 1)]]
        return sum_over_processes(torch.where(ours[:, None], fresh, 0.0))

    # -- starting ------------------------------------------------------------------------------

    @torch.no_grad()
    def kmeans_init(self, vectors: Tensor, generator: torch.Generator | None = None) -> None:
        """Set the codes by k-means over the vectors (M, D) of all processes; called once, by training.

        With fewer vectors than codes some codes start equal; replacing dead codes separates them. Without vectors
        nothing is set.
        """
        pool = _gather(_some(vectors.float(), KMEANS_VECTORS * self.size, generator))
        if not len(pool):
            return
        pool = _some(pool, KMEANS_VECTORS * self.size, generator)
        for book in range(self.num_quantizers):
            codes = _broadcast(_kmeans(pool, self.size, generator))
            self.codes[book] = codes
            pool = pool - codes[_nearest(pool, codes)]
        self.ema_count.fill_(1.0)
        self.ema_sum.copy_(self.codes)
        self.initialized.fill_(True)


def _nearest(vectors: Tensor, codes: Tensor) -> Tensor:
    """Index of the code nearest to each vector. (M, D), (codes, D) -> (M,)"""
    # |v|^2 is the same for every code.
    return (codes.square().sum(-1) - 2 * vectors @ codes.T).argmin(-1)


def _kmeans(vectors: Tensor, codes: int, generator: torch.Generator | None) -> Tensor:
    """Centres (codes, D) of vectors (M, D); a centre without vectors stays where it was drawn."""
    order = _rand(len(vectors), vectors.device, generator).argsort()
    centres = vectors[order[torch.arange(codes, device=vectors.device) % len(vectors)]]
    for _ in range(KMEANS_ROUNDS):
        chosen = _nearest(vectors, centres)
        onto = F.one_hot(chosen, codes).to(vectors.dtype)
        count = onto.sum(0)[:, None]
        centres = torch.where(count > 0, onto.T @ vectors / count.clamp(min=1), centres)
    return centres


def _some(vectors: Tensor, most: int, generator: torch.Generator | None) -> Tensor:
    if len(vectors) <= most:
        return vectors
    return vectors[_rand(len(vectors), vectors.device, generator, shared=False).argsort()[:most]]


# -- over processes ----------------------------------------------------------------------------


def together() -> bool:
    """Whether several processes train one model right now."""
    return dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1


def sum_over_processes(tensor: Tensor) -> Tensor:
    """The sum of a tensor over all processes, the same bits in each; alone, the tensor."""
    if together():
        tensor = tensor.contiguous()
        dist.all_reduce(tensor)
    return tensor


def _broadcast(tensor: Tensor) -> Tensor:
    if together():
        tensor = tensor.contiguous()
        dist.broadcast(tensor, src=0)
    return tensor


def _rand(n: int, device: torch.device, generator: torch.Generator | None, shared: bool = True) -> Tensor:
    """Uniform draws (n,), by default those of rank 0 in every process."""
    draws = torch.rand(n, generator=generator, device=device if generator is None else generator.device).to(device)
    return _broadcast(draws) if shared else draws


def _before_mine(mine: Tensor) -> tuple[Tensor, Tensor]:
    """How many vectors the processes before this one hold, and how many all hold."""
    if not together():
        return torch.zeros_like(mine), mine
    sizes = [torch.zeros_like(mine) for _ in range(dist.get_world_size())]
    dist.all_gather(sizes, mine)
    return torch.stack(sizes)[: dist.get_rank()].sum(), torch.stack(sizes).sum()


def _gather(vectors: Tensor) -> Tensor:
    """The vectors (M, D) of all processes, M may differ, in order of rank."""
    if not together():
        return vectors
    mine = torch.tensor(len(vectors), device=vectors.device)
    sizes = [torch.zeros_like(mine) for _ in range(dist.get_world_size())]
    dist.all_gather(sizes, mine)
    lengths = [int(size) for size in sizes]
    padded = vectors.new_zeros(max(lengths), vectors.shape[1])
    padded[: len(vectors)] = vectors
    parts = [torch.empty_like(padded) for _ in lengths]
    dist.all_gather(parts, padded)
    return torch.cat([part[:length] for part, length in zip(parts, lengths, strict=True)])
