"""The lock of a store: one holder, who renews it, and one successor when it expires."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from object_stores import s3_server

from lagbench.errors import WorkFailedError
from lagbench.store import lease as leases
from lagbench.store.lease import lease
from lagbench.store.remote import Remote


@pytest.fixture(scope="module")
def base() -> Iterator[str]:
    """An S3 server."""
    with s3_server() as url:
        yield url


@pytest.fixture
def remote(base: str, request: pytest.FixtureRequest) -> Remote:
    """A folder of its own there."""
    return Remote(base, request.node.name)


def locks(remote: Remote) -> dict[str, dict[str, Any]]:
    """Return all locks by name."""
    return {name: json.loads(remote.read(name) or b"") for name in remote.beside()}


def leave_lock(remote: Remote, number: int, seconds: float) -> None:
    """Leave a lock as a killed holder does, that expires in so many seconds."""
    until = (datetime.now(UTC) + timedelta(seconds=seconds)).isoformat()
    lock = {"pid": 4711, "host": "lost", "since": "then", "expires": until, "released": False, "token": "x"}
    assert remote.create(f".lock.{number:06d}", json.dumps(lock).encode())


def test_a_second_writer_is_told_who_holds_it(remote: Remote) -> None:
    """Process, host and time are in the error; afterwards the lock is free, under the next number."""
    with lease(remote), pytest.raises(WorkFailedError, match=r"process \d+ on .*, until ") as caught:
        lease(remote, timeout=0).__enter__()
    assert caught.value.where == remote.url
    with lease(remote, timeout=0):
        assert list(locks(remote)) == [".lock.000002"]
    assert [lock["released"] for lock in locks(remote).values()] == [True]


def test_a_second_writer_waits(remote: Remote, monkeypatch: pytest.MonkeyPatch) -> None:
    """It says once for whom, and goes on when the first has ended."""
    monkeypatch.setattr(leases, "POLL", 0.02)
    told: list[str] = []
    order: list[str] = []

    def second() -> None:
        with lease(remote, on_wait=told.append):
            order.append("second")

    with lease(remote):
        thread = threading.Thread(target=second)
        thread.start()
        while not told:
            time.sleep(0.01)
        time.sleep(0.1)
        order.append("first")
    thread.join()
    assert order == ["first", "second"]
    assert len(told) == 1


def test_an_expired_lock_has_one_successor(remote: Remote, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two who have both seen it expired one holds the next number, the other is refused."""
    leave_lock(remote, 7, -leases.SKEW - 1)
    both, done = threading.Barrier(2), threading.Barrier(2)
    looked: set[int] = set()
    last = leases._last

    def together(where: Remote) -> Any:
        found = last(where)
        if threading.get_ident() not in looked:
            looked.add(threading.get_ident())
            both.wait(10)
        return found

    monkeypatch.setattr(leases, "_last", together)
    results: list[str] = []

    def racer() -> None:
        try:
            with lease(remote, timeout=0):
                results.append("held")
                done.wait(10)
        except WorkFailedError as error:
            results.append(error.what)
            done.wait(10)

    threads = [threading.Thread(target=racer) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(results) == ["another process writes this data set", "held"]
    assert list(locks(remote)) == [".lock.000008"]


def test_a_lock_that_may_still_hold_is_respected(remote: Remote) -> None:
    """Within the skew of clocks an expired lock is not taken over."""
    leave_lock(remote, 1, 1 - leases.SKEW)
    with pytest.raises(WorkFailedError, match="process 4711 on lost"):
        lease(remote, timeout=0).__enter__()


def test_who_looked_long_ago_gets_no_number_that_was_held(
    remote: Remote, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A number below one that is there holds nothing, though its creation succeeds."""
    stale = leases._last(remote)
    with lease(remote):
        assert list(locks(remote)) == [".lock.000001"]
    with lease(remote):
        answers = iter([stale])
        last = leases._last
        monkeypatch.setattr(leases, "_last", lambda where: next(answers, None) or last(where))
        with pytest.raises(WorkFailedError, match="another process writes"):
            lease(remote, timeout=0).__enter__()
        assert list(locks(remote)) == [".lock.000002"]


def test_the_holder_renews_it(remote: Remote, monkeypatch: pytest.MonkeyPatch) -> None:
    """While it is held the time of its end moves on, also from a thread."""
    monkeypatch.setattr(leases, "RENEW", 0.02)
    with lease(remote) as held:
        first = locks(remote)[".lock.000001"]["expires"]
        while locks(remote)[".lock.000001"]["expires"] == first:
            time.sleep(0.01)
        held.check()


def test_a_lock_that_was_taken_over_is_lost(remote: Remote) -> None:
    """A holder that slept too long writes nothing any more, and leaves the successor's lock alone."""
    with lease(remote) as held:
        leave_lock(remote, 2, 100.0)
        held.renew()
        with pytest.raises(WorkFailedError, match=r"was lost\n(.*\n)*.*process 4711 on lost"):
            held.check()
    assert not locks(remote)[".lock.000002"]["released"]


def test_a_lock_that_could_not_be_renewed_is_lost(remote: Remote, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once it has expired the holder stops, whoever holds it now."""
    monkeypatch.setattr(leases, "LASTS", 0.0)
    with lease(remote) as held:
        time.sleep(0.01)
        with pytest.raises(WorkFailedError, match="it expired"):
            held.check()


def test_a_store_without_conditional_put_has_no_lock(remote: Remote, monkeypatch: pytest.MonkeyPatch) -> None:
    """What answers that it does not implement it is refused, with the way around."""

    def refuse(*_: object, **__: object) -> None:
        raise OSError(38, "A header you provided implies functionality that is not implemented")

    monkeypatch.setattr(remote._system, "pipe_file", refuse)
    with pytest.raises(WorkFailedError, match="knows no conditional put") as caught:
        lease(remote).__enter__()
    assert "local folder" in str(caught.value.fix)


def test_the_last_of_two_holds_it_where_conditions_are_ignored(
    remote: Remote, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who does not find its own word in the lock after creating it does not hold it."""

    def ignoring(name: str, data: bytes) -> bool:
        remote.write(name, data)
        leave = json.loads(data) | {"token": "another", "pid": 4711}
        remote.write(name, json.dumps(leave).encode())
        return True

    monkeypatch.setattr(remote, "create", ignoring)
    with pytest.raises(WorkFailedError, match="process 4711"):
        lease(remote, timeout=0).__enter__()


@pytest.mark.parametrize("kind", ["file", "memory"])
def test_other_stores_create_conditionally_too(kind: str, tmp_path: Path) -> None:
    """A folder and memory keep the first of two."""
    place = Remote(f"{kind}://{tmp_path}", "a/b/v1")
    assert place.create(".lock.000001", b"one")
    assert not place.create(".lock.000001", b"two")
    assert place.read(".lock.000001") == b"one"
    assert place.sizes() == {".lock.000001": 3}
