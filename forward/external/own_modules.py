"""The modules of a user's Python model: their files, found without running them, and whether they have changed.

Imports are read from a module's source, including those inside functions; modules loaded by a computed name are known
once they are loaded. Data files that it reads cannot be known.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import importlib.metadata
import json
import sys
import sysconfig
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from importlib.machinery import ModuleSpec, PathFinder
from itertools import chain, count
from pathlib import Path
from types import ModuleType
from typing import Any

from forward.machine import modified
from forward.model import ModelError

_texts: dict[str, tuple[str, str]] = {}  # files of imported modules, and the hashes of their contents
_walked: dict[str, tuple[tuple[object, ...], dict[str, tuple[str, str]]]] = {}  # folders and files of modules, as found
VALUES = ("__closure__", "__defaults__", "__kwdefaults__", "__self__")  # that a function may hold
SESSION = "__session__"  # a module of functions that were given themselves, in scripts and notebooks
_TISSUQ = ("forward", "uq", "inverse", "workflows", "tissuq")
_refused: ContextVar[list[str] | None] = ContextVar("refused", default=None)  # where not all may be imported


class OwnCodeError(ModelError):
    """What was asked for needs code that is neither of this program nor installed, where none of it may run."""


@contextmanager
def installed_only() -> Iterator[list[str]]:
    """Within this, no module that a study names is imported unless it is installed, and no folder is searched.

    A study is read in many places, and other studies that it names too: all of them import by `imported`, and find
    modules by `search`.

    Yields
    ------
    list
        Modules that were asked for and not imported, up to now.
    """
    refusals: list[str] = []
    before = _refused.set(refusals)
    try:
        yield refusals
    finally:
        _refused.reset(before)


def refused(module: str) -> bool:
    """Whether a module may not be imported here: it is not installed, within `installed_only`."""
    if _refused.get() is None:
        return False
    file = _file(find(module))
    return file is None or _is_own(file)


@dataclass(frozen=True)
class Sources:
    """What a model's answers depend on besides its parameters.

    Attributes
    ----------
    files
        (path, SHA-256) of the modules that are neither in Python's standard library nor installed, by module.
    versions
        Versions of the installed distributions that these modules import, or to which the model belongs.
    """

    files: dict[str, tuple[str, str]]
    versions: dict[str, str]

    @property
    def digest(self) -> str:
        """One hash of all, wherever the files are."""
        contents = [sorted((name, text) for name, (_, text) in self.files.items()), sorted(self.versions.items())]
        return hashlib.sha256(repr(contents).encode()).hexdigest()

    @property
    def folders(self) -> tuple[Path, ...]:
        """Where these modules were found; for packages, the folder that contains the package."""
        found = (
            Path(path).parents[name.count(".") + (Path(path).stem == "__init__")]
            for name, (path, _) in self.files.items()
            if not _is_installed(Path(path))
        )
        return tuple(dict.fromkeys(found))

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Sources:
        """Make sources from tables of JSON."""
        files = {str(name): (str(path), str(text)) for name, (path, text) in document["files"].items()}
        return cls(files, {str(name): str(version) for name, version in document["versions"].items()})

    def change(self, now: Sources) -> str | None:
        """Say what has changed since, or None if nothing has."""
        for module, (path, text) in self.files.items():
            file, found = now.files.get(module) or (path, hashed(Path(path)))
            if found != text:
                return f"{file} {'has changed' if found else 'is gone'}"
        for module in now.files.keys() - self.files.keys():
            return f"{now.files[module][0]} is new"
        for name in sorted(self.versions.keys() | now.versions.keys()):
            before, after = (of.versions.get(name, "absent") for of in (self, now))
            if before != after:
                return f"{name} was {before}, and is {after}"
        return None


def sources(modules: Iterable[str], kinds: Iterable[str] = ()) -> Sources:
    """Return the sources of modules, by their dotted names, without running them.

    Parameters
    ----------
    modules
        Modules of which what is installed counts by its version.
    kinds
        Modules that make kinds of blocks: their packages count by their text too where they are installed, since who
        writes an energy installs it again and again.
    """
    files: dict[str, tuple[str, str]] = {}
    versions: dict[str, str] = {}
    kinds = list(kinds)
    tops = {name.partition(".")[0] for name in kinds}
    for name, spec, _ in _walk([*modules, *kinds], tops):
        file = _file(spec)
        if file is None:
            continue
        if _is_users(name, file, tops):
            files[name] = (str(file), hashed(file))
        if _is_installed(file):
            distribution = _distribution(name.partition(".")[0])
            if distribution is None:
                files[name] = (str(file), hashed(file))
            else:
                versions[distribution] = importlib.metadata.version(distribution)
    return Sources(files, versions)


def other_code(change: str) -> str:
    """Say that results in a directory come from code that has changed."""
    return f"holds results of other code: {change}; choose another --out"


def hashed(file: Path) -> str:
    """Return the SHA-256 of a file; empty if it cannot be read."""
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError:
        return ""


class Loaded:
    """The user's modules that were loaded since this was made, with the hashes of their files when first seen."""

    def __init__(self) -> None:
        self._before = frozenset(sys.modules)
        self._files: dict[str, tuple[str, str]] = {}
        self._others: dict[str, str] = {}  # files of modules that are not the user's: they are asked about once

    def __call__(self) -> dict[str, tuple[str, str]]:
        """Return (path, SHA-256) by module."""
        for name in sys.modules.keys() - self._before - self._files.keys():
            file = getattr(sys.modules[name], "__file__", None)
            if isinstance(file, str) and file.endswith(".py") and name != "__main__" and self._others.get(name) != file:
                path = Path(file).absolute()
                if _is_own(path):
                    self._files[name] = (str(path), hashed(path))
                else:
                    self._others[name] = file
        return self._files

    def note(self) -> str:
        """Describe them, to be stored with the results that depend on them; empty if there are none."""
        files = self()
        return json.dumps(files, sort_keys=True) if files else ""

    def objection(self, note: str) -> str | None:
        """Say which of the files in a note has changed, if any."""
        change = Sources.of({"files": json.loads(note or "{}"), "versions": {}}).change(Sources({}, {}))
        return None if change is None else other_code(change)


def search(folders: Iterable[Path]) -> None:
    """Let Python look for modules in some folders too, after all other places, unless only what is installed runs."""
    if _refused.get() is None:
        sys.path += [name for name in dict.fromkeys(map(str, folders)) if name not in sys.path]


def path_of(function: Any) -> str:
    """Return the dotted path of what is called; what no module holds under its name is kept in `SESSION`.

    There other functions of the same name, such as those that a factory makes, are numbered.
    """
    module, name = (getattr(function, of, "") for of in ("__module__", "__name__"))
    held = sys.modules.get(module)
    scripted = module == "__main__" or getattr(held, "__spec__", None) is None
    if scripted or getattr(held, name, None) is not function:
        module, session = SESSION, vars(sys.modules.setdefault(SESSION, ModuleType(SESSION)))
        name = name if name.isidentifier() else "function"
        names = chain([name], (f"{name}_{k}" for k in count(2)))
        name = next(one for one in names if one not in session or _alike(session[one], function))
        session[name] = function
    return f"{module}.{name}"


def _alike(one: Any, other: Any) -> bool:
    """Whether functions are the same: defined once more in a notebook, by code that holds no values of its own."""
    codes, around = ([getattr(f, of, None) for f in (one, other)] for of in ("__code__", "__globals__"))
    own = any(getattr(f, of, None) is not None for f in (one, other) for of in VALUES)
    same = codes[0] is not None and codes[0] == codes[1] and around[0] is around[1]
    return one is other or (same and not own)


def make_visible(modules: Iterable[str], folders: Iterable[Path], place: str = "model.function") -> None:
    """Let Python find modules in some folders too, after all other places; `place` is where the study names them.

    Raises
    ------
    ModelError
        If one of them, or a module imported from these folders, has the same name as a module found elsewhere, so that
        it is ambiguous.
    """
    if _refused.get() is not None:
        return
    names = [str(folder) for folder in folders]
    elsewhere = [entry for entry in sys.path if str(Path(entry or ".").resolve()) not in names]
    search(map(Path, names))
    importers = {(module.partition(".")[0], ""): "" for module in modules}
    for name, spec, imported in _walk(list(modules)):
        file = _file(spec)
        if file is not None and any(file.is_relative_to(folder) for folder in names):
            importers |= {(other.partition(".")[0], name): str(file) for other in imported}
    for (top, _), importer in importers.items():
        beside = _file(PathFinder.find_spec(top, names))
        other = None if beside is None else _elsewhere(top, elsewhere, beside)
        if other is not None:
            what = f"{importer} imports '{top}', which" if importer else f"'{top}'"
            message = f"{place}: {what} is both {beside} and {other}, expected a name of its own: rename the first"
            raise ModelError(message)


def imported(module: str) -> ModuleType:
    """Import a module, again if its file or source, or those of its imports, have changed since the last import.

    Raises
    ------
    OwnCodeError
        If it may not be imported here.
    """
    refusals = _refused.get()
    if refusals is not None and refused(module):
        refusals.append(module)
        raise OwnCodeError(f"'{module}' is not installed, and code from beside a study runs with --code alone")
    now = _files_of(module)
    for name, (file, _) in now.items():
        known = getattr(sys.modules.get(name), "__file__", None) or file
        if _texts.get(name, now[name]) != now[name] or (name not in _texts and Path(known).absolute() != Path(file)):
            for changed in now.keys() & sys.modules.keys():
                del sys.modules[changed]
            break
    _texts.update(now)
    kept, sys.dont_write_bytecode = sys.dont_write_bytecode, True  # it would hide changes made within a second
    try:
        return importlib.import_module(module)
    finally:
        sys.dont_write_bytecode = kept


def _files_of(module: str) -> dict[str, tuple[str, str]]:
    """Return (path, SHA-256) by module of what a module is made of.

    Its imports are followed again only if a text has changed, or a folder in which they are looked for: a solve asks
    for its energy many times.
    """
    folders, files = _walked.get(module, (None, {}))
    unchanged = folders == _folders(files) and all(hashed(Path(file)) == text for file, text in files.values())
    if not (unchanged and module in sys.modules):
        importlib.invalidate_caches()
        files = sources([module]).files
        _walked[module] = _folders(files), files
    return files


def _folders(files: Mapping[str, tuple[str, str]]) -> tuple[object, ...]:
    """Where modules are looked for: finders, and folders with their times, which change with the names in them."""
    around = (str(Path(file).parent) for file, _ in files.values())
    return (*sys.meta_path, *((folder, modified(folder)) for folder in (*sys.path, *around)))


def find(module: str) -> ModuleSpec | None:
    """Find a module by its dotted name as Python would now, without importing its packages."""
    top, *rest = module.split(".")
    spec, name = _found(top), top
    for step in rest:
        if spec is None or spec.submodule_search_locations is None:
            return None
        name = f"{name}.{step}"
        spec = PathFinder.find_spec(name, list(spec.submodule_search_locations))
    return spec


def _found(top: str) -> ModuleSpec | None:
    """Find a top-level module or package."""
    for finder in sys.meta_path:
        try:
            spec = finder.find_spec(top, None)
        except (ImportError, ValueError, AttributeError):
            continue
        if spec is not None:
            return spec
    return None


def _elsewhere(top: str, path: list[str], beside: Path) -> str | None:
    """Say what else has the name of a module beside a study, if anything: on the path, or in this program."""
    if top in sys.builtin_module_names or top in sys.stdlib_module_names:
        return "a module of Python's standard library"
    if top in _TISSUQ:
        return None if _is_tissuq(beside) else "a package of this program"
    file = _file(PathFinder.find_spec(top, path))
    return None if file in {None, beside} else f"another module, {file}"


def _walk(modules: Iterable[str], tops: Collection[str] = ()) -> Iterator[tuple[str, ModuleSpec, set[str]]]:
    """Walk through modules and their imports, as far as they are the user's own: name, location, imports."""
    waiting, seen = list(modules), set[str]()
    while waiting:
        parts = waiting.pop().split(".")
        for name in (".".join(parts[: i + 1]) for i in range(len(parts))):
            if name in seen:
                continue
            seen.add(name)
            spec = find(name)
            if spec is None:
                break
            file = _file(spec)
            imported = _imports(name, spec, file) if file is not None and _is_users(name, file, tops) else set()
            waiting += sorted(imported - seen)
            yield name, spec, imported


def _imports(name: str, spec: ModuleSpec, file: Path) -> set[str]:
    """Read from the source of a module what it may import; errors in it are reported when it is imported."""
    try:
        tree = ast.parse(file.read_bytes())
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
        return set()
    package = name if spec.submodule_search_locations is not None else name.rpartition(".")[0]
    found = set[str]()
    for node in ast.walk(tree):
        match node:
            case ast.Import():
                found |= {alias.name for alias in node.names}
            case ast.ImportFrom():
                around = package.split(".")
                base = [] if node.level == 0 else around[: len(around) - node.level + 1]
                base += node.module.split(".") if node.module else []
                found |= {".".join([*base, alias.name]) for alias in node.names if alias.name != "*"}
                found.add(".".join(base))
            case ast.Call(func=ast.Name(id=called) | ast.Attribute(attr=called), args=[ast.Constant(value=str(word))]):
                if called in {"import_module", "__import__"}:
                    found.add(word)
            case _:
                pass
    return {word for word in found if word and all(part.isidentifier() for part in word.split("."))}


def _file(spec: ModuleSpec | None) -> Path | None:
    return Path(spec.origin).absolute() if spec is not None and spec.has_location and spec.origin else None


@cache
def _library() -> tuple[Path, ...]:
    return tuple(Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib"))


def _is_installed(file: Path) -> bool:
    return not {"site-packages", "dist-packages"}.isdisjoint(file.parts)


def _is_tissuq(file: Path) -> bool:
    root = Path(__file__).resolve().parents[2]
    return any(file.is_relative_to(root / package) for package in _TISSUQ)


def _is_own(file: Path) -> bool:
    """Whether it is neither installed, nor of the standard library, nor of this program."""
    library = any(file.resolve().is_relative_to(folder) for folder in _library())
    return not (library or _is_installed(file) or _is_tissuq(file))


def _is_users(name: str, file: Path, tops: Collection[str]) -> bool:
    """Whether a module counts by its text: the user's own, or of one of these packages of kinds."""
    return _is_own(file) or (name.partition(".")[0] in tops and not _is_tissuq(file))


@cache
def _distribution(top: str) -> str | None:
    """Return the name of the distribution to which a module or package belongs."""
    try:
        importlib.metadata.version(top)
    except importlib.metadata.PackageNotFoundError:
        return next(iter(_distributions().get(top, [])), None)
    return top


_distributions = cache(importlib.metadata.packages_distributions)  # which reads the lists of files of all
