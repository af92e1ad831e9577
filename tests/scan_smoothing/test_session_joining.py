"""Which groups of sessions are compared, how often, and what is told of those that stay apart."""

from types import SimpleNamespace

import numpy as np
import pytest

from graphslam.core.geometry import between, compose
from graphslam.core.records import Start
from graphslam.multi_robot.hypothesis_choice import Refusal, Telling
from graphslam.scan_smoothing import session_joining
from graphslam.scan_smoothing.session_joining import MAX_LAID, merge

AT = Start(np.zeros(3), np.eye(3), np.eye(3))
ALONE = 10


class Group(session_joining._Group):
    """A group whose map has so many places as a test says."""

    places = ALONE

    @property
    def map(self):
        return SimpleNamespace(places=range(self.places))


def group(*names, places=ALONE):
    made = Group(dict.fromkeys(names, AT), (), {})
    object.__setattr__(made, "places", places)
    return made


@pytest.fixture
def compared(monkeypatch):
    """The pairs that are compared, as names; ``rule(one, other)`` says what comes of a pair."""

    def use(rule, grows=ALONE):
        pairs = []

        def joined(one, other, _sessions, _config):
            pairs.append((tuple(one.starts), tuple(other.starts)))
            refusal = rule(tuple(one.starts), tuple(other.starts))
            return refusal or group(*one.starts, *other.starts, places=one.places + grows)

        monkeypatch.setattr(session_joining, "_joined", joined)
        return pairs

    return use


def refusal(telling, text="why"):
    return Refusal(text, telling)


def test_a_session_that_only_the_grown_group_tells_is_compared_twice(compared):
    """It was tried again after each of the others: 13 comparisons of eight sessions, not eight."""
    few = refusal(Telling.FEW)
    pairs = compared(lambda one, other: few if other == ("b",) and len(one) < 7 else None)
    groups = [group(name) for name in "abcdefgh"]
    assert merge(groups, {}, None)["b"] == "in the map of a: why"
    assert len(groups) == 1
    assert len(pairs) == 8
    assert [other for _, other in pairs].count(("b",)) == 2


def test_what_was_refused_is_tried_again_only_if_more_is_known(compared):
    """A map that hardly grew tells no more: the comparison takes seconds."""
    few = refusal(Telling.FEW)
    for grows, times in ((0, 1), (ALONE, 2)):
        pairs = compared(lambda _one, other: few if other == ("b",) else None, grows)
        groups = [group(name) for name in "abc"]
        merge(groups, {}, None)
        assert len(groups) == 2
        assert [other for _, other in pairs].count(("b",)) == times


def test_the_most_telling_reason_is_told_and_whose_map_it_is_of(compared):
    """The last one was: that c has little in common with b hid that it fits into a in two ways."""

    def rule(one, other):
        if other == ("c",):
            return refusal(Telling.RIVALS, "two") if one == ("a",) else refusal(Telling.FEW, "few")
        return refusal(Telling.CONTRADICTED, "against")

    compared(rule)
    told = merge([group(name) for name in "abc"], {}, None)
    assert told == {"b": "in the map of a: against", "c": "in the map of a: two"}


def test_a_session_is_searched_for_once_in_a_map(monkeypatch):
    """Refused alone and tried again as a part of a group, in a map that is the same."""
    searched = []

    def search(_log, name, _map, _own):
        searched.append(name)
        return [AT]

    monkeypatch.setattr(session_joining, "possible_starts", search)
    one = group("a")
    sessions = {n: SimpleNamespace(name=n, log=None, own=None) for n in "bc"}
    for names in ("b", "c", "bc"):
        assert len(session_joining._hypotheses(one, group(*names), sessions)) == 1
    assert searched == ["b", "c"]


def test_hypotheses_about_a_group_are_as_many_however_many_sessions_it_has(monkeypatch):
    """Each is laid for every session: those that more sessions have are judged, not all of each."""
    far = {name: 100.0 * k for k, name in enumerate("bcdefg")}

    def search(_log, name, _map, _own):
        own = [Start(np.array([far[name] + 5 * k, 0, 0]), np.eye(3), np.eye(3)) for k in range(5)]
        return [*own, AT]  # the last of each, and all have it

    monkeypatch.setattr(session_joining, "possible_starts", search)
    sessions = {n: SimpleNamespace(name=n, log=None, own=None) for n in far}
    found = session_joining._hypotheses(group("a"), group(*far), sessions)
    assert len(found) == MAX_LAID
    assert np.allclose(found[0]["g"].pose, 0)


def test_told_starts_are_of_bases_whatever_the_mounts():
    """States are sensors' poses, and the first session's begins where its base is told to be.

    So between two sensors it is as their mounts at the told bases say.
    """
    mounts = {"mon": np.array([0.4, 0.1, 0.2]), "tue": np.array([-0.2, 0.3, -1.0])}
    told = {
        "mon": Start(np.array([5.0, 2.0, 1.0]), np.eye(3)),
        "tue": Start(np.array([-3.0, 1.0, 2.5]), np.eye(3)),
    }
    sessions = {
        name: SimpleNamespace(
            runs={
                name: SimpleNamespace(track=SimpleNamespace(mount=mount, mount_cov=0 * np.eye(3)))
            }
        )
        for name, mount in mounts.items()
    }
    first, later = (session_joining._of_first_state(sessions, n, "mon", told) for n in mounts)
    np.testing.assert_allclose(first.pose, told["mon"].pose)
    sensors = [compose(told[name].pose, mount) for name, mount in mounts.items()]
    np.testing.assert_allclose(between(first.pose, later.pose), between(*sensors), atol=1e-12)
