"""What agents tell by ZeroMQ, and what they hear of others who tell what they should not."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from magnet.agents.zeromq import Link, engine, make_keys
from tests.agents.addresses import addresses_of, ports


@pytest.fixture
def context() -> Iterator[Any]:
    """ZeroMQ's, of another program; ends with the test, whatever fails."""
    context = engine().Context()
    yield context
    context.destroy(linger=0)


def told_at(context: Any, address: str) -> Any:
    """A socket that tells there, as soon as who was there before has let go of it."""
    zmq, out, end = engine(), context.socket(engine().PUB), time.monotonic() + 10
    while True:
        try:
            out.bind(address)
            return out
        except zmq.ZMQError:
            if time.monotonic() > end:
                raise
            time.sleep(0.02)


def test_without_keys_only_this_machine_is_spoken_to():
    with pytest.raises(ValueError, match="not an address of this machine"):
        Link("A", "tcp://0.0.0.0:5601", {})
    with pytest.raises(ValueError, match="not an address of this machine"):
        Link("A", "tcp://127.0.0.1:5601", {"B": "tcp://192.168.0.2:5602"})


def test_with_keys_members_hear_each_other_and_strangers_hear_nothing(tmp_path):
    for name in "AB":
        make_keys(tmp_path / "ours", name)
    make_keys(tmp_path / "theirs", "B")
    (tmp_path / "theirs" / "A.key").write_text((tmp_path / "ours" / "A.key").read_text())
    addresses = addresses_of("ABX")
    one = Link("A", addresses["A"], {"B": addresses["B"]}, tmp_path / "ours")
    two = Link("B", addresses["B"], {"A": addresses["A"]}, tmp_path / "ours")
    stranger = Link("B", addresses["X"], {"A": addresses["A"]}, tmp_path / "theirs")
    plain = Link("C", f"tcp://127.0.0.1:{ports(1)[0]}", {"A": addresses["A"]})
    end, heard = time.monotonic() + 10, []
    while not heard and time.monotonic() < end:
        one.send([b"magnet/A", b"hello"])
        heard = two.receive(0.05)
    assert heard and heard[0] == ("A", [b"magnet/A", b"hello"])
    for _ in range(3):
        one.send([b"magnet/A", b"hello"])
    assert stranger.receive(0.2) == [] and plain.receive(0.1) == []
    for link in (one, two, stranger, plain):
        link.close()


@pytest.mark.parametrize("address", ["tcp://10.0.0.1", "tcp://bad host:5602", "udp://10.0.0.1:5602", "robot:5602"])
def test_what_is_not_an_address_is_named_and_not_the_one_beside_it(address: str, tmp_path: Path) -> None:
    for name in "AB":
        make_keys(tmp_path, name)
    for listen, connect in ((address, "tcp://10.0.0.2:5602"), (addresses_of("A")["A"], address)):
        with pytest.raises(ValueError, match=f"^{re.escape(address)} is not an address: expected tcp://HOST:PORT"):
            Link("A", listen, {"B": connect}, tmp_path)


@pytest.mark.skipif(not socket.has_ipv6, reason="no IPv6")
def test_an_address_of_this_machine_may_be_of_ipv6() -> None:
    try:
        with socket.create_server(("::1", 0), family=socket.AF_INET6) as probe:
            address = f"tcp://[::1]:{probe.getsockname()[1]}"
    except OSError:
        pytest.skip("no IPv6 address of this machine")
    one = Link("A", address, {})
    two = Link("B", addresses_of("B")["B"], {"A": address})
    end, heard = time.monotonic() + 10, []
    while not heard and time.monotonic() < end:
        one.send([b"magnet/A", b"hello"])
        heard = two.receive(0.05)
    assert heard[0] == ("A", [b"magnet/A", b"hello"])
    one.close()
    two.close()


@pytest.mark.parametrize("rebinds", [False, True])
def test_who_sends_a_message_over_the_size_now_and_then_is_heard_soon_after_each(context: Any, rebinds: bool) -> None:
    """ZeroMQ gives up an address then, whether the process that listens there is the same or the next.

    When only who was silent for ten seconds was connected to anew, such a message each five seconds met it each time.
    """
    addresses, said = addresses_of("AB"), []
    link = Link("A", addresses["A"], {"B": addresses["B"]}, say=said.append)
    link.receive(0.5)  # nobody is there yet
    out = told_at(context, addresses["B"])

    def hears(within: float) -> bool:
        end = time.monotonic() + within
        while time.monotonic() < end:
            out.send_multipart([b"magnet/B", b"hello"])
            if link.receive(0.05):
                return True
        return False

    assert hears(10)
    for number in range(3):
        out.send_multipart([b"magnet/B", b"x" * 70_000])
        while link.receive(0.2):
            pass
        if rebinds:
            out.close(linger=0)
            out = told_at(context, addresses["B"])
        assert hears(3) and link.closed == {"B": number + 1}
    assert len(said) == 1 and said[0].startswith("B sent a part of over 65536 bytes, or what is no message")
    out.close(linger=0)  # ends as processes do: ZeroMQ itself connects to the next
    link.receive(0.5)
    out = told_at(context, addresses["B"])
    assert hears(10) and link.closed == {"B": 3}
    link.close()


def test_a_message_of_very_many_parts_is_read_in_many_turns_and_not_kept(context: Any) -> None:
    """Else who reads it does nothing else until its end."""
    addresses = addresses_of("AB")
    link = Link("A", addresses["A"], {"B": addresses["B"]})
    out = told_at(context, addresses["B"])
    turns, heard, end = 0, [], time.monotonic() + 20
    while not heard and time.monotonic() < end:
        out.send_multipart([b"magnet/B", b"hello"])
        heard = link.receive(0.05)
    out.send_multipart([b"magnet/B", *[b"x"] * 20_000])
    out.send_multipart([b"magnet/B", b"after"])
    while heard[-1][1][-1] != b"after" and time.monotonic() < end:
        heard += link.receive(0.05)
        turns += 1
    assert turns > 50 and heard[-1] == ("B", [b"magnet/B", b"after"])
    assert len(heard[-2][1]) == 6, "as many as are refused"
    link.close()


def heard_saying(link: Link, beside: Link, seconds: float = 10) -> list[str]:
    """What a link says that hears nobody, while another is there."""
    end = time.monotonic() + seconds
    said: list[str] = []
    link.say = said.append
    while not said and time.monotonic() < end:
        link.receive(0.05)
        beside.receive(0.0)
    link.close()
    return said


def test_who_cannot_be_heard_for_a_key_or_a_name_is_said_why(tmp_path) -> None:
    for name in "AB":
        make_keys(tmp_path / "ours", name)
    make_keys(tmp_path / "theirs", "B")
    (tmp_path / "theirs" / "A.key").write_text((tmp_path / "ours" / "A.key").read_text())
    addresses = addresses_of("AB")
    one = Link("A", addresses["A"], {}, tmp_path / "ours")

    def says(address: str, keys: Path | None) -> list[str]:
        return heard_saying(Link("B", addresses["B"], {"A": address}, keys), one)

    assert says(addresses["A"], tmp_path / "theirs") == ["A does not know our key: A's folder of keys needs ours"]
    no_keys = f"what listens at {addresses['A']} has not A's keys, or one of the two has none"
    assert says(addresses["A"], None) == [no_keys]
    nowhere = "tcp://nowhere.invalid:5601"
    assert says(nowhere, tmp_path / "ours") == [
        f"no way to the host of {nowhere} is found, and is looked for again and again"
    ]
    one.close()


UNSHARE = ("unshare", "--map-root-user", "--mount", "--net", "sh", "-ec")
NOBODY = """
ip link set lo up
ip link add here type veth peer name there
ip addr add 10.7.1.2/24 dev here
ip link set here up
ip link set there up
ip neigh add 10.7.1.1 lladdr 02:00:00:00:00:01 dev here
echo nameserver 10.7.1.1 > resolv.conf
mount --bind resolv.conf /etc/resolv.conf
"""
"""A machine whose name server does not answer."""
HEARD = """
import sys, time
from pathlib import Path
from magnet.agents.zeromq import Link
keys, here, there = Path("keys"), "tcp://127.0.0.1:5601", "tcp://127.0.0.1:5602"
one = Link("A", here, {"B": there, "C": "tcp://robot.example:5603"}, keys)
two = Link("B", there, {"A": here}, keys)
end, heard = time.monotonic() + 4, [0, 0]
while time.monotonic() < end:
    for number, (link, other) in enumerate(((one, two), (two, one))):
        other.send([b"magnet/", b"hello"])
        heard[number] += len(link.receive(0.05))
print(*heard, flush=True)
"""


@pytest.mark.slow
def test_while_a_name_is_looked_up_in_vain_all_others_are_heard(tmp_path: Path) -> None:
    """Looking it up takes ten seconds, and then begins again."""
    tried = subprocess.run([*UNSHARE, NOBODY], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    if tried.returncode:
        pytest.skip(f"namespaces cannot be made here: {tried.stderr.strip()}")
    for name in "ABC":
        make_keys(tmp_path / "keys", name)
    (tmp_path / "heard.py").write_text(HEARD)
    words = [*UNSHARE, f'{NOBODY}\nexec "$0" heard.py', sys.executable]
    made = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert made.returncode == 0, made.stderr
    assert min(map(int, made.stdout.split())) > 10
