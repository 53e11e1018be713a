"""Kinds by name: what is asked for is imported, what cannot be is said with its place."""

import importlib.metadata
import sys
from typing import Annotated

import pytest
from pydantic import TypeAdapter, ValidationError

from forward.registry import Kinds, OfKind
from forward.settings import Settings

pytestmark = pytest.mark.unit

LOADS = Kinds("load", {"gravity": "forward.terms.loads:Gravity", "traction": "forward.terms.loads:Traction"})


class Body(Settings):
    """A block with blocks of registered kinds."""

    loads: tuple[Annotated[Settings, OfKind(LOADS)], ...] = ()
    first: Annotated[Settings, OfKind(LOADS, "gravity")]


OUTSIDE = """
from forward.settings import Settings


class Wind(Settings):
    kind: str
    speed: float


class Storm:
    pass
"""


@pytest.fixture
def outside(tmp_path, monkeypatch):
    (tmp_path / "my_loads.py").write_text(OUTSIDE)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("my_loads", None)


def test_blocks_are_read_and_written_as_what_they_are(outside):
    given = {
        "loads": [{"kind": "traction", "on": "top", "size": 1.0, "direction": [1.0, 0.0, 0.0]}],
        "first": {"kind": "my_loads.Wind", "speed": 3.0},
    }
    body = Body.model_validate(given)
    assert [type(one).__name__ for one in (*body.loads, body.first)] == ["Traction", "Wind"]
    assert Body.model_validate(body.model_dump(mode="json")) == body
    assert Body(first={"density": 2.0}).first.kind == "gravity"


@pytest.mark.parametrize(
    ("first", "place", "said"),
    [
        ({"kind": "gravity", "density": -1.0}, ("first", "density"), "greater than or equal to 0"),
        ({"density": 1.0, "densty": 2}, ("first", "densty"), "unknown key"),
        ({"kind": "tracton"}, ("first", "kind"), "did you mean 'traction'?"),
        ({"kind": "nowhere.at_all"}, ("first", "kind"), "the load 'nowhere.at_all' cannot be imported"),
        ({"kind": "my_loads.Wnd"}, ("first", "kind"), "has no load 'Wnd'; did you mean 'Wind'?"),
        ({"kind": "my_loads.Storm"}, ("first", "kind"), "expected a subclass of Settings"),
        ({"kind": 3}, ("first", "kind"), "expected a word"),
        (3, ("first",), "expected a table"),
    ],
)
def test_mistakes_have_their_places(outside, first, place, said):
    with pytest.raises(ValidationError) as caught:
        Body.model_validate({"first": first})
    (line,) = caught.value.errors()
    assert line["loc"] == place
    assert said in line["msg"]


def test_the_schema_knows_the_kinds():
    schema = TypeAdapter(Body).json_schema()
    named = {one["$ref"].rpartition("/")[2] for one in schema["properties"]["first"]["anyOf"] if "$ref" in one}
    assert named == {"Gravity", "Traction"}
    assert named <= schema["$defs"].keys()


def test_metadata_of_installed_packages_are_read_once(outside, tmp_path, monkeypatch):
    """A solve asks for its energy many times; a package that is installed meanwhile is found."""
    read = []

    def entry_points(**group):
        read.append(group)
        return found(**group)

    found = importlib.metadata.entry_points
    monkeypatch.setattr(importlib.metadata, "entry_points", entry_points)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # compiled modules would change their folder once more
    assert "gale" not in LOADS
    read.clear()
    assert "gale" not in LOADS
    assert not read
    information = tmp_path / "my_loads-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: my-loads\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[tissuq]\nload.gale = my_loads:Wind\n")
    for _ in range(3):
        assert LOADS["gale"].__name__ == "Wind"
    assert len(read) == 1
