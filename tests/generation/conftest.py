"""What several tests of sampling share."""

import pytest

from magnet.testing import tiny_denoiser


@pytest.fixture(scope="module")
def model():
    return tiny_denoiser(max_agents=3, window=8)
