"""Mutations of studies: trees of TOML with something deleted, renamed, retyped or made absurd, from a seed."""

import copy
import random
import string

ABSURD = [
    0,
    -1,
    1,
    -0.0,
    10**9,
    10**30,
    1e300,
    1e-300,
    -1e5,
    float("nan"),
    float("inf"),
    float("-inf"),
    True,
    False,
    "",
    " ",
    "x",
    "no/such/file.csv",
    "/",
    ".",
    "é∇ü漢🎈",
    "\u202e\t\n\x00",
    "{}{0}%s",
    "x" * 5000,
    [],
    [[]],
    [{}],
    [[[[1]]]],
    ["a", "b"],
    [1.0, 2.0],
    list(range(3000)),
    {},
    {"kind": []},
    {"kind": {}},
    {"kind": "x"},
    {"kind": 3},
    {"a": {"b": {"c": 1}}},
    {"": 1},
    {"x" * 3000: 1},
]


def places(tree, way=()):
    """All ways to what stands in a tree."""
    found = []
    for key in list(tree) if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else []:
        found += [(*way, key), *places(tree[key], (*way, key))]
    return found


def mutated(document, chance):
    """A copy of a document with one to three changes; what was done is returned too."""
    tree, done = copy.deepcopy(document), []
    for _ in range(chance.choice([1, 1, 1, 2, 3])):
        ways = places(tree)
        if ways:
            way, kind = chance.choice(ways), chance.choice(sorted(CHANGES))
            CHANGES[kind](tree, way, chance)
            done.append((kind, way))
    return without_none(tree), done


def at(tree, way):
    """What stands at the end of a way."""
    for step in way:
        tree = tree[step]
    return tree


def absurd(tree, way, chance):
    at(tree, way[:-1])[way[-1]] = copy.deepcopy(chance.choice(ABSURD))


def delete(tree, way, chance):
    del at(tree, way[:-1])[way[-1]]


def rename(tree, way, chance):
    here = at(tree, way[:-1])
    if isinstance(here, dict):
        here[chance.choice([misspelt(way[-1], chance), *here, "kind", "x" * 3000])] = here.pop(way[-1])


def wrap(tree, way, chance):
    value = at(tree, way)
    at(tree, way[:-1])[way[-1]] = chance.choice([[value], {"value": value}, {"kind": value}, str(value), [value] * 2])


def move(tree, way, chance):
    elsewhere = at(tree, chance.choice(places(tree))[:-1])
    if isinstance(elsewhere, dict) and isinstance(way[-1], str):
        elsewhere[way[-1]] = copy.deepcopy(at(tree, way))


def scale(tree, way, chance):
    value = at(tree, way)
    if isinstance(value, int | float):
        at(tree, way[:-1])[way[-1]] = type(value)(chance.choice([-1, 0, 2, 3, 10, 1000]) * value)


def add(tree, way, chance):
    value = at(tree, way)
    if isinstance(value, dict):
        value[chance.choice(["kind", "name", "x", "samples", ""])] = copy.deepcopy(chance.choice(ABSURD))


def repeat(tree, way, chance):
    here = at(tree, way[:-1])
    if isinstance(here, list):
        here.append(copy.deepcopy(here[way[-1]]))


CHANGES = {"absurd": absurd, "another absurd": absurd, "delete": delete, "rename": rename, "wrap": wrap, "move": move}
CHANGES |= {"scale": scale, "add": add, "repeat": repeat}


def misspelt(word, chance):
    """A word with a letter that is another one, or missing."""
    if not word:
        return "x"
    i = chance.randrange(len(word))
    return word[:i] + chance.choice(["", chance.choice(string.ascii_letters + "._- ")]) + word[i + 1 :]


def without_none(tree):
    """TOML has none."""
    if isinstance(tree, dict):
        return {str(key): without_none(value) for key, value in tree.items() if value is not None}
    return [without_none(item) for item in tree if item is not None] if isinstance(tree, list) else tree


def mutations(documents, count, seed=0):
    """Pairs (name, document, what was done), the same for a seed."""
    chance = random.Random(seed)
    names = sorted(documents)
    for _ in range(count):
        name = chance.choice(names)
        yield name, *mutated(documents[name], chance)


# --- files -----------------------------------------------------------------------------------------------------------

CELLS = ["", " ", "nan", "inf", "1e400", "-1e308", "0", "-1", "x", "1,5", '"', "\x00", "é漢🎈", "\u202e", "1_000"]
CELLS += ["0x10", "x" * 5000, "1e-320", "\ufeff", "#", "{}%s"]


def damaged_table(text, chance):
    """Bytes of a table of comma-separated values with one to three mistakes, and what was done."""
    lines, done = text.splitlines(), []
    for _ in range(chance.choice([1, 1, 2, 3])):
        body = [i for i, line in enumerate(lines) if not line.startswith("#")]
        if not body:
            break
        i, kind = (
            chance.choice(body),
            chance.choice(["cell", "cell", "head", "cut", "twice", "sign", "end", "line", "column"]),
        )
        done.append((kind, i))
        cells = lines[i].split(",")
        match kind:
            case "cell":
                cells[chance.randrange(len(cells))] = chance.choice(CELLS)
                lines[i] = ",".join(cells)
            case "head":
                head = lines[body[0]].split(",")
                head[chance.randrange(len(head))] = chance.choice([*CELLS, *head])
                lines[body[0]] = ",".join(head)
            case "cut":
                lines[i] = ",".join(cells[: chance.randrange(len(cells))])
            case "twice":
                lines.insert(i, lines[i])
            case "sign":
                lines = [line.replace(",", chance.choice([";", "\t", " ", ",,"])) for line in lines]
            case "end":
                whole = "\n".join(lines)
                lines = whole[: chance.randrange(len(whole) + 1)].splitlines()
            case "line":
                lines.insert(chance.randrange(len(lines) + 1), chance.choice([*CELLS, "# truth.x = ", ",,,,,,"]))
            case "column":
                k = chance.randrange(len(cells))
                lines = [",".join(c for j, c in enumerate(line.split(",")) if j != k) for line in lines]
    return "\n".join(lines).encode(), done


def damaged_bytes(whole, chance):
    """Bytes with some that are cut off, left out, put in or flipped, or with another number."""
    found = bytearray(whole)
    i, kind = chance.randrange(len(found)), chance.choice(["cut", "flip", "number", "drop", "insert"])
    match kind:
        case "cut":
            del found[i:]
        case "flip":
            found[i] ^= 1 << chance.randrange(8)
        case "number":
            digits = [k for k, byte in enumerate(found) if 48 <= byte <= 57] or [i]
            i = chance.choice(digits)
            found[i : i + 1] = chance.choice([b"9", b"-1", b"99999", b"nan", b"1e309", b"x"])
        case "drop":
            del found[i : i + chance.randrange(1, 200)]
        case "insert":
            found[i:i] = chance.randbytes(chance.randrange(1, 40))
    return bytes(found), (kind, i)
