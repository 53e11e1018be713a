"""Public methods are documented: in the class that has them first, and where they differ."""

from __future__ import annotations

import ast

from tests.house import files


def test_methods_are_documented_where_they_are_first():
    methods: dict[str, dict[str, bool]] = {}
    bases: dict[str, set[str]] = {}
    for one in (node for file in files() for node in file.classes()):
        found = {node.name: bool(ast.get_docstring(node)) for node in one.body if isinstance(node, ast.FunctionDef)}
        methods.setdefault(one.name, {}).update(found)
        names = (base.value if isinstance(base, ast.Subscript) else base for base in one.bases)
        bases.setdefault(one.name, set()).update(getattr(name, "attr", getattr(name, "id", "")) for name in names)

    def documented(name: str, method: str) -> bool:
        return methods.get(name, {}).get(method, False) or any(documented(base, method) for base in bases.get(name, ()))

    bare = [
        f"{name}.{method}"
        for name, found in methods.items()
        for method in found
        if not name.startswith("_") and not method.startswith("_") and not documented(name, method)
    ]
    assert bare == []
