"""Laws of the codebook."""

from __future__ import annotations

import datetime
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from torch import Tensor

from magnet.tokenizer.quantizer import ResidualVQ
from magnet.tokenizer.usage import CodeUse, perplexity, usage


def clusters(n: int, generator: torch.Generator, dim: int = 8, groups: int = 16) -> Tensor:
    centres = 5 * torch.randn(groups, dim, generator=torch.Generator().manual_seed(1))
    which = torch.randint(groups, (n,), generator=generator)
    return centres[which] + 0.1 * torch.randn(n, dim, generator=generator)


def test_latent_is_the_nearest_code(generator: torch.Generator) -> None:
    book = ResidualVQ(16, 8).eval()
    book.codes.normal_(generator=generator)
    vectors = torch.randn(3, 5, 8, generator=generator)
    out = book(vectors)
    distance = (vectors[..., None, :].double() - book.codes[0].double()).square().sum(-1)
    assert torch.equal(out.index[..., 0], distance.argmin(-1))
    assert torch.equal(out.latent, book.codes[0][distance.argmin(-1)])
    torch.testing.assert_close(out.commitment, (distance.min(-1).values / 8).mean().float())


def test_quantising_a_code_returns_it_bit_identical(generator: torch.Generator) -> None:
    book = ResidualVQ(64, 8)
    book.kmeans_init(clusters(500, generator), generator)
    latent = book.nearest(clusters(50, generator))
    assert torch.equal(book.nearest(latent), latent)


def test_codes_follow_the_moving_average_of_their_vectors(generator: torch.Generator) -> None:
    book = ResidualVQ(4, 8, ema_decay=0.9, dead_code_threshold=0.0)
    book.kmeans_init(clusters(100, generator), generator)
    count, total = book.ema_count[0].double(), book.ema_sum[0].double()
    for _ in range(5):
        vectors = clusters(60, generator)
        index = book(vectors).index[:, 0]
        for code in range(4):
            mine = vectors[index == code].double()
            count[code] = 0.9 * count[code] + 0.1 * len(mine)
            total[code] = 0.9 * total[code] + 0.1 * mine.sum(0)
        torch.testing.assert_close(book.ema_count[0].double(), count, rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(book.codes[0].double(), total / count[:, None], rtol=1e-4, atol=1e-5)


def test_kmeans_start_finds_the_clusters_whatever_the_first_codes(generator: torch.Generator) -> None:
    book = ResidualVQ(64, 8)
    vectors = clusters(2000, generator)
    book(vectors, generator=generator)
    error = (book.nearest(vectors) - vectors).norm(dim=-1).mean()
    assert bool(book.initialized)
    assert error < 0.5  # within-cluster spread is 0.1 * sqrt(8) = 0.28, clusters are about 20 apart


def test_same_seed_starts_the_same_codes() -> None:
    books = [ResidualVQ(16, 8) for _ in range(2)]
    for book in books:
        book.kmeans_init(clusters(300, torch.Generator().manual_seed(0)), torch.Generator().manual_seed(5))
    assert torch.equal(books[0].codes, books[1].codes)


def test_dead_codes_come_back_as_vectors_of_the_batch(generator: torch.Generator) -> None:
    book = ResidualVQ(16, 8, dead_code_threshold=1.0)
    book.kmeans_init(clusters(300, generator), generator)
    book.codes[0, 3] = 1e3
    book.ema_sum[0, 3] = 1e3
    book.ema_count[0, 3] = 0.0
    vectors = clusters(200, generator)
    book(vectors, generator=generator)
    assert (vectors == book.codes[0, 3]).all(-1).any()


def test_any_unmasked_vector_may_take_a_dead_codes_place_and_no_other(generator: torch.Generator) -> None:
    """The first one and the last one too: 255 dead codes draw among 20 vectors."""
    book = ResidualVQ(256, 8, dead_code_threshold=1.0)
    book.kmeans_init(clusters(600, generator), generator)
    book.codes[0, 1:] = book.ema_sum[0, 1:] = 1e3
    book.ema_count[0, 1:] = 0.0
    vectors, mask = clusters(40, generator), torch.arange(40) % 2 == 1
    book(vectors, mask, generator)
    equal = (book.codes[0, 1:, None] == vectors).all(-1)
    assert equal.any(1).all(), "each is a vector of the batch"
    assert torch.equal(equal.any(0), mask)


@pytest.mark.parametrize(("vectors", "dies"), [(4, False), (16, False), (64, True), (400, True)])
def test_few_vectors_kill_few_codes(vectors: int, dies: bool, generator: torch.Generator) -> None:
    """A code that was chosen seldom is dead only where a batch has vectors enough to choose it."""
    book = ResidualVQ(16, 8, ema_decay=0.9, dead_code_threshold=1.0)
    book.kmeans_init(clusters(300, generator), generator)
    book.codes[0, 3] = 1e3
    book.ema_count[0, 3], book.ema_sum[0, 3] = 0.5, 0.5e3
    book(clusters(vectors, generator), generator=generator)
    assert bool((book.codes[0, 3] != 1e3).any()) == dies


@pytest.mark.parametrize(("vectors", "least"), [(16, 0.25), (32, 0.5), (64, 1.0), (400, 1.0)])
def test_a_code_dies_below_one_vector_a_batch_and_below_less_in_batches_of_fewer_than_four_a_code(
    vectors: int, least: float, generator: torch.Generator
) -> None:
    """And comes back with just enough weight to stay where the coming batches choose it."""
    book = ResidualVQ(16, 8, ema_decay=0.9, dead_code_threshold=1.0)
    book.kmeans_init(clusters(300, generator), generator)
    counts = torch.tensor([0.98, 1.02]) * least / 0.9  # before they are lowered by this batch
    book.codes[0, 3:5] = 1e3
    book.ema_count[0, 3:5], book.ema_sum[0, 3:5] = counts, 1e3 * counts[:, None]
    book(clusters(vectors, generator), generator=generator)
    assert (book.codes[0, 3:5] == 1e3).all(-1).tolist() == [False, True]
    assert book.ema_count[0, 3] == least
    torch.testing.assert_close(book.ema_sum[0, 3], least * book.codes[0, 3])


def test_without_revival_an_unused_code_does_not_move(generator: torch.Generator) -> None:
    book = ResidualVQ(16, 8, dead_code_threshold=0.0)
    book.kmeans_init(clusters(300, generator), generator)
    book.codes[0, 3] = 1e3
    book.ema_sum[0, 3] = 1e3
    for _ in range(3):
        book(clusters(200, generator), generator=generator)
    assert (book.codes[0, 3] == 1e3).all()


def test_a_code_that_nobody_chose_stays_where_it_is_to_the_bit(generator: torch.Generator) -> None:
    """A sum over a count, each times the decay, is nearly that."""
    book = ResidualVQ(64, 8, dead_code_threshold=0.0)
    book.kmeans_init(clusters(300, generator), generator)
    book.codes[0, 32:] = book.ema_sum[0, 32:] = 1e3 + torch.randn(32, 8, generator=generator)
    before = book.codes.clone()
    for _ in range(3):
        book(clusters(200, generator), generator=generator)
    assert torch.equal(book.codes[0, 32:], before[0, 32:])


@pytest.mark.parametrize("books", [1, 3])
def test_commitment_is_the_mean_square_over_kept_vectors_and_codebooks(books: int, generator: torch.Generator) -> None:
    quantizer = ResidualVQ(16, 8, books).eval()
    quantizer.codes.normal_(generator=generator)
    vectors, mask = torch.randn(40, 8, generator=generator), torch.arange(40) % 3 == 0
    residual, errors = vectors[mask].double(), []
    for codes in quantizer.codes.double():
        residual = residual - codes[torch.cdist(residual, codes).argmin(-1)]
        errors.append(residual.square().mean())
    found = quantizer(vectors, mask).commitment
    torch.testing.assert_close(found.double(), torch.stack(errors).mean(), rtol=1e-5, atol=0)


def test_codebooks_start_each_from_what_those_before_it_leave(generator: torch.Generator) -> None:
    vectors = clusters(2000, generator)
    errors = []
    for books in (1, 2, 3):
        quantizer = ResidualVQ(16, 8, books)
        quantizer.kmeans_init(vectors, torch.Generator().manual_seed(0))
        errors.append(float((quantizer.nearest(vectors) - vectors).norm(dim=-1).mean()))
    assert errors[1] < 0.5 * errors[0] and errors[2] < 0.9 * errors[1]


def test_codes_that_start_from_fewer_vectors_are_those_vectors_all_of_them(generator: torch.Generator) -> None:
    vectors = torch.randn(3, 8, generator=generator)
    book = ResidualVQ(8, 8)
    book.kmeans_init(vectors, generator)
    equal = torch.cdist(book.codes[0], vectors) < 1e-5
    assert equal.any(0).all() and equal.any(1).all()


@pytest.mark.parametrize("levels", [1, 3])
def test_masked_vectors_never_touch_the_codebook(levels: int, generator: torch.Generator) -> None:
    vectors = clusters(200, generator).view(10, 20, 8)
    mask = torch.rand(10, 20, generator=generator) < 0.7
    states, commitments, counts = [], [], []
    for junk in (0.0, 1e6, float("nan")):
        book = ResidualVQ(16, 8, levels)
        for step in range(3):
            garbled = torch.where(mask[..., None], vectors, junk)
            out = book(garbled, mask, torch.Generator().manual_seed(step))
        states.append(book.state_dict())
        commitments.append(out.commitment)
        counts.append(out.counts)
        assert (out.index[~mask] == -1).all()
    for state, commitment, count in zip(states[1:], commitments[1:], counts[1:], strict=True):
        assert all(torch.equal(state[name], states[0][name]) for name in state)
        assert torch.equal(commitment, commitments[0])
        assert torch.equal(count, counts[0]) and count.sum() == levels * mask.sum()


def test_a_batch_with_nobody_changes_nothing(generator: torch.Generator) -> None:
    book = ResidualVQ(16, 8)
    nobody = torch.zeros(40, dtype=torch.bool)
    book(clusters(40, generator), nobody, generator)
    assert not bool(book.initialized)
    book.kmeans_init(clusters(300, generator), generator)
    before = {name: value.clone() for name, value in book.state_dict().items()}
    out = book(clusters(40, generator), nobody, generator)
    assert out.commitment == 0
    assert all(torch.equal(before[name], value) for name, value in book.state_dict().items())


@pytest.mark.parametrize("how", ["eval", "frozen"])
def test_frozen_codebook_never_moves(how: str, generator: torch.Generator) -> None:
    book = ResidualVQ(16, 8)
    book.kmeans_init(clusters(300, generator), generator)
    before = {name: value.clone() for name, value in book.state_dict().items()}
    if how == "eval":
        book.eval()
    else:
        book.frozen = True
    book(clusters(200, generator) + 3, generator=generator)
    assert all(torch.equal(before[name], value) for name, value in book.state_dict().items())


def test_each_residual_level_lowers_the_error(generator: torch.Generator) -> None:
    book = ResidualVQ(8, 8, num_quantizers=4)
    vectors = clusters(1000, generator)
    for _ in range(20):
        book(vectors, generator=generator)
    errors = []
    residual = vectors
    for level in range(4):
        code = book.codes[level][torch.cdist(residual, book.codes[level]).argmin(-1)]
        residual = residual - code
        errors.append(float(residual.square().mean()))
    assert errors == sorted(errors, reverse=True)
    torch.testing.assert_close(book.nearest(vectors), vectors - residual, rtol=1e-4, atol=1e-4)


def test_gradient_passes_straight_through(generator: torch.Generator) -> None:
    book = ResidualVQ(16, 8, num_quantizers=2)
    vectors = clusters(50, generator).requires_grad_()
    out = book(vectors, generator=generator)
    slope = torch.randn(50, 8, generator=generator)
    (gradient,) = torch.autograd.grad((out.latent * slope).sum(), vectors, retain_graph=True)
    torch.testing.assert_close(gradient, slope)
    (pull,) = torch.autograd.grad(out.commitment, vectors)
    assert pull.isfinite().all() and (pull != 0).any()


def test_loading_neither_moves_nor_restarts_the_codebook(generator: torch.Generator) -> None:
    book = ResidualVQ(16, 8, num_quantizers=2)
    for _ in range(3):
        book(clusters(200, generator), generator=generator)
    loaded = ResidualVQ(16, 8, num_quantizers=2)
    loaded.load_state_dict(book.state_dict())
    vectors = clusters(200, generator) + 1
    looked_up = book.eval()(vectors)
    first = loaded.train()(vectors, generator=generator)
    assert torch.equal(first.latent, looked_up.latent)
    # 200 vectors at decay .99 weigh 1 % of their number: codes that moved, moved by the average alone.
    moved = (loaded.codes - book.codes).norm(dim=-1)
    farthest = (vectors[:, None] - book.codes[0]).norm(dim=-1).max()
    assert moved.max() < farthest
    count = first.counts[0]
    expected = 0.99 * book.ema_sum[0] + 0.01 * torch.zeros(16, 8).index_add(0, first.index[:, 0], vectors)
    alive = 0.99 * book.ema_count[0] + 0.01 * count >= 200 / 64
    torch.testing.assert_close(loaded.ema_sum[0][alive], expected[alive], rtol=1e-4, atol=1e-4)


def test_perplexity_lies_between_one_and_the_number_of_codes(generator: torch.Generator) -> None:
    assert perplexity(torch.tensor([7.0, 0, 0, 0])) == 1
    torch.testing.assert_close(perplexity(torch.full((4,), 3.0)), torch.tensor(4.0))
    counts = torch.randint(0, 9, (50, 32), generator=generator)
    counts[:, 0] += 1
    assert ((perplexity(counts) >= 1) & (perplexity(counts) <= 32 + 1e-4)).all()
    assert usage(torch.tensor([7.0, 0, 0, 1])) == 0.5


def test_code_use_adds_up_over_updates() -> None:
    metric = CodeUse(2, 4)
    metric.update(torch.tensor([[4, 0, 0, 0], [1, 1, 0, 0]]))
    metric.update(torch.tensor([[0, 4, 0, 0], [0, 0, 1, 1]]))
    result = metric.compute()
    torch.testing.assert_close(result["perplexity_0"], torch.tensor(2.0))
    torch.testing.assert_close(result["perplexity_1"], torch.tensor(4.0))
    assert result["usage_0"] == 0.5 and result["usage_1"] == 1


def test_half_precision_autocast_looks_up_in_float32(generator: torch.Generator) -> None:
    book = ResidualVQ(64, 8)
    book.kmeans_init(clusters(500, generator), generator)
    book.eval()
    vectors = clusters(100, generator)
    with torch.autocast("cpu", torch.bfloat16):
        out = book(vectors)
    assert torch.equal(out.latent, book(vectors).latent) and out.latent.dtype == torch.float32


# -- several processes -------------------------------------------------------------------------


def _rank(rank: int, world: int, folder: str) -> None:
    torch.set_num_threads(1)
    book = ResidualVQ(16, 8, num_quantizers=2)  # made before the process group, as Lightning does
    given = ResidualVQ(16, 8, dead_code_threshold=0.0)
    given.load_state_dict(torch.load(f"{folder}/given.pt"))
    dying = ResidualVQ(64, 8)
    dying.load_state_dict({**dying.state_dict(), "initialized": torch.tensor(True), "ema_count": torch.zeros(1, 64)})
    meet = f"file://{folder}/meet"
    patience = datetime.timedelta(seconds=60)
    dist.init_process_group("gloo", init_method=meet, rank=rank, world_size=world, timeout=patience)
    generator = torch.Generator().manual_seed(100 + rank)  # ranks differ, in data and in draws
    with torch.no_grad():
        for step in range(6):
            # At first one holds more than k-means takes of a process, then none does.
            vectors = clusters((50 + 30 * rank) if step else (100, 300)[rank], generator)
            mask = torch.rand(len(vectors), generator=generator) < (0.0 if (rank, step) == (1, 2) else 0.8)
            counts = book(vectors, mask, generator).counts
        given(vectors, mask, generator)
        dying(vectors + 100, mask, generator)  # none is near a code at zero but those of one
    state = book.state_dict(), given.state_dict(), dying.codes[0]
    torch.save((*state, vectors[mask], counts), f"{folder}/{rank}.pt")
    dist.destroy_process_group()


def test_codebooks_of_two_processes_stay_bit_identical(tmp_path: Path, generator: torch.Generator) -> None:
    alone = ResidualVQ(16, 8, dead_code_threshold=0.0)
    alone.kmeans_init(clusters(300, generator), generator)
    torch.save(alone.state_dict(), tmp_path / "given.pt")
    # Forked and not spawned: importing torch anew takes half a minute on a busy machine.
    mp.start_processes(_rank, args=(2, str(tmp_path)), nprocs=2, start_method="fork")
    (mine, given, revived, vectors, counts), (other, other_given, other_revived, more, _) = (
        torch.load(tmp_path / f"{rank}.pt") for rank in range(2)
    )
    assert bool(mine["initialized"])
    assert all(torch.equal(mine[name], other[name]) for name in mine)
    assert all(torch.equal(given[name], other_given[name]) for name in given)
    assert counts[0].sum() == len(vectors) + len(more)
    # Whoever takes a dead code's place is a vector of either process.
    assert torch.equal(revived, other_revived)
    theirs = [(revived[1:, None] == 100 + some).all(-1) for some in (vectors, more)]
    assert torch.cat(theirs, dim=1).any(1).all() and all(some.any() for some in theirs)
    # Two processes learn what one would from all the vectors.
    alone(torch.cat([vectors, more]))
    for name, value in alone.state_dict().items():
        torch.testing.assert_close(given[name], value)
