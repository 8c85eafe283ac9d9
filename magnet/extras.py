"""Optional packages: what adds them to this installation."""

from __future__ import annotations

import json
from importlib.metadata import PackageNotFoundError, distribution
from urllib.parse import urlsplit
from urllib.request import url2pathname

PACKAGE = "magnet-motion"


def installing(extra: str) -> str:
    """The command that adds an extra, for messages: a clone that is installed as it lies is named by its folder.

    >>> installing("usd")[:12], installing("usd")[-6:]
    ('pip install ', '[usd]"')
    """
    try:
        said = json.loads(distribution(PACKAGE).read_text("direct_url.json") or "{}")
    except (PackageNotFoundError, ValueError):
        said = {}
    if not said.get("dir_info", {}).get("editable"):
        return f'pip install "{PACKAGE}[{extra}]"'
    return f'pip install -e "{url2pathname(urlsplit(said["url"]).path)}[{extra}]"'
