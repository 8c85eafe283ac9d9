"""Few vectors find the codes that a search through whole codebooks finds."""

import pytest
import torch
from torch import Tensor

from magnet.tokenizer.code_search import DIMENSIONS, FEW, Book
from magnet.tokenizer.quantizer import OFTEN, ResidualVQ


def quantizer(generator: torch.Generator, rank: int, aside: float) -> ResidualVQ:
    """Three books of 200 codes of 96 numbers near a space of few dimensions, each finer than the one before."""
    book = ResidualVQ(200, 96, num_quantizers=3).eval()
    space = torch.randn(3, rank, 96, generator=generator)
    codes = torch.randn(3, 200, rank, generator=generator) @ space + aside * torch.randn(
        3, 200, 96, generator=generator
    )
    book.codes.copy_(codes * torch.tensor([1.0, 0.4, 0.1])[:, None, None])
    return book


def by_distances(book: ResidualVQ, vectors: Tensor) -> Tensor:
    found = torch.zeros_like(vectors)
    for codes in book.codes:
        found = found + codes[torch.cdist((vectors - found).double(), codes.double()).argmin(dim=1)]
    return found


@pytest.mark.parametrize("rank, aside", [(10, 0.05), (10, 2.0), (96, 0.0)])
def test_few_vectors_get_the_nearest_codes_wherever_codes_and_vectors_lie(rank, aside, generator):
    book = quantizer(generator, rank, aside)
    for _ in range(OFTEN):
        book.nearest(torch.zeros(1, 96))
    assert len(book.books()) == 3
    for spread in (0.1, 5.0):
        near = book.codes[0][:200] + spread * torch.randn(200, 96, generator=generator)
        for vectors in near.split(FEW):
            assert torch.equal(book.nearest(vectors), by_distances(book, vectors))
            assert torch.equal(book.nearest(vectors[None, :1]), by_distances(book, vectors[:1])[None])


def test_hardly_any_codes_are_looked_at_whole_where_codes_lie_together(generator, monkeypatch):
    book = quantizer(generator, DIMENSIONS // 4, 0.02)
    looked: list[int] = []
    whole = Book.of(book.codes[0])

    class Counted:
        def __getitem__(self, index):
            looked.append(len(index))
            return whole.codes[index]

    counted = Book(Counted(), whole.lengths, whole.basis, whole.near, whole.beyond)  # type: ignore[arg-type]
    vectors = book.codes[0][:50] + 0.1 * torch.randn(50, 96, generator=generator)
    for vector in vectors.split(1):
        counted.nearest(vector.numpy())
    assert len(looked) == 50
    assert sum(looked) < 3 * 50


def test_codes_that_change_are_searched_anew(generator):
    book = quantizer(generator, 10, 0.05)
    vectors = torch.randn(4, 96, generator=generator)
    for _ in range(OFTEN):
        before = book.nearest(vectors)
    book.codes.neg_()
    assert not torch.equal(book.nearest(vectors), before)
    for _ in range(OFTEN):
        assert torch.equal(book.nearest(vectors), by_distances(book, vectors))


def test_a_few_lookups_prepare_nothing(generator, monkeypatch):
    prepared: list[Tensor] = []
    made = Book.of
    monkeypatch.setattr(Book, "of", lambda codes: prepared.append(codes) or made(codes))
    book = quantizer(generator, 10, 0.05)
    for _ in range(OFTEN - 1):
        book.nearest(torch.zeros(1, 96))
    book.nearest(torch.zeros(FEW + 1, 96))
    assert not prepared
    book.nearest(torch.zeros(FEW, 96))
    assert len(prepared) == 3


def test_numbers_that_are_none_are_no_error(generator):
    book = quantizer(generator, 10, 0.05)
    for _ in range(OFTEN):
        book.nearest(torch.zeros(1, 96))
    assert book.nearest(torch.full((2, 96), torch.nan)).shape == (2, 96)


def test_threads_that_share_codes_never_search_some_of_the_books(generator, monkeypatch):
    """Another thread's lookup is answered while books are being made: from all of them or from none."""
    book, made, found, busy = quantizer(generator, 10, 0.05), Book.of, [], False

    def interrupted(codes: Tensor) -> Book:
        nonlocal busy
        if not busy:
            busy = True
            found.append(len(book.books()))
            busy = False
        return made(codes)

    monkeypatch.setattr(Book, "of", interrupted)
    for _ in range(OFTEN):
        book.nearest(torch.zeros(1, 96))
    assert found and set(found) <= {0, 3}
    assert len(book.books()) == 3


def test_another_default_dtype_of_torch_changes_nothing(generator):
    codes = quantizer(generator, 10, 0.05).codes[0]
    whole = Book.of(codes)
    torch.set_default_dtype(torch.float64)
    try:
        again = Book.of(codes)
    finally:
        torch.set_default_dtype(torch.float32)
    assert (again.basis == whole.basis).all() and again.basis.dtype == whole.basis.dtype
