"""Pages that mkdocs makes from the program: reference, study files, and what pages quote by a line ``{{ … }}``.

Docstrings are read from the source, so that nothing has to be imported (and no FEniCSx be there) to build the site.
"""

from __future__ import annotations

import ast
import contextlib
import importlib.metadata
import io
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = {
    "workflows": "Studies, results, pictures and reports",
    "uq": "Methods and estimators",
    "inverse": "Inversion and model selection",
    "forward": "Bodies and other models",
}
SECTIONS = ("Parameters", "Attributes", "Returns", "Yields", "Raises", "Notes", "References")
COMMANDS = ("check", "run", "solve", "report", "reduce", "live", "serve", "init", "schema", "completion")
# In formulas, letters (ω, or an x that ends no word) with what stands low and high beside them.
SUBSCRIPT = re.compile(r"((?<![A-Za-z0-9_])[A-Za-z][\u0300-\u036f]?|[^\x00-\x7f])_(\{[^}]*\}|[A-Za-z0-9~]+)")
SUPERSCRIPT = re.compile(r"(\S)\^(\{[^}]*\}|\([^)]*\)|[A-Za-z0-9]+)")
Function = ast.FunctionDef | ast.AsyncFunctionDef


# --- what mkdocs calls -----------------------------------------------------------------------------------------------


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages."""
    from mkdocs.structure.files import File

    for place, text in pages():
        files.append(File.generated(config, place, content=text))
    files.append(File.generated(config, "assets/mathjax.js", abs_src_path=str(mathjax())))
    return files


def mathjax() -> Path:
    """Return the script that typesets formulas, of a package that holds a copy of MathJax."""
    package = importlib.metadata.distribution("sphinx-mathjax-offline")
    return Path(str(package.locate_file(f"{package.name}/static/mathjax/tex-svg.js")))


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Put in what a page quotes; studies that it links to have a place on the site."""
    return re.sub(r"\]\(\.\./configs/([\w-]+)\.toml\)", r"](studies.md#\1)", quoted(markdown))


# --- pages -----------------------------------------------------------------------------------------------------------


def pages() -> Iterator[tuple[str, str]]:
    """Return the generated pages: where each goes, and its text."""
    yield "overview.md", overview((ROOT / "README.md").read_text(encoding="utf-8"))
    for name in ("CONTRIBUTING.md", "CODE_OF_CONDUCT.md", "SECURITY.md"):
        yield name, overview((ROOT / name).read_text(encoding="utf-8"))
    yield "studies.md", shipped()
    yield "decisions.md", decisions()
    yield "reference/settings.md", settings()
    yield "reference/commands.md", commands()
    lines = ["# Modules", "", "Every public name with its docstring, from the source.", ""]
    for package, title in PACKAGES.items():
        lines += [f"## {title}: `{package}`", ""]
        for path in modules(package):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            tree = parsed(path)
            doc = ast.get_docstring(tree) or ""
            lines.append(f"- [`{name}`]({name}.md): {prose(doc.partition(chr(10))[0])}")
            yield f"reference/{name}.md", module_page(tree, name)
        lines.append("")
    yield "reference/modules.md", "\n".join(lines)


def overview(readme: str) -> str:
    """Return the README, or a page beside it, with its links as of the site."""
    text = readme.replace("](docs/", "](")
    text = re.sub(r"\]\(configs/([\w-]+)\.toml\)", r"](studies.md#\1)", text)
    return re.sub(r"\[(`[^`]+`)\]\((?:configs|notebooks)\b[^)]*\)", r"\1", text)  # other files are not on the site


def shipped() -> str:
    """Return a page with all studies that come with the program."""
    lines = ["# Shipped studies", "", "All of them are in `configs/`; `tissuq run configs/NAME.toml` runs one.", ""]
    for path in sorted((ROOT / "configs").glob("*.toml")):
        lines += [f"## {path.stem}", "", fenced("toml", path.read_text(encoding="utf-8")), ""]
    return "\n".join(lines)


def decisions() -> str:
    """Return a page that lists the decisions."""
    lines = ["# Decisions", "", "Why some things are as they are, each with what was measured.", ""]
    for path in sorted((ROOT / "docs" / "decisions").glob("*.md")):
        title = path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
        lines.append(f"- [{title}](decisions/{path.name})")
    return "\n".join([*lines, ""])


def commands() -> str:
    """Return the help texts of the command line."""
    lines = ["# Commands", "", fenced("text", help_of()), ""]
    for name in COMMANDS:
        lines += [f"## tissuq {name}", "", fenced("text", help_of(name)), ""]
    lines += [
        "Exit codes: 0 done; 1 failed, with one line that says why; 2 bad study or arguments; 3 finished, but some "
        "solves failed.",
        "",
    ]
    return "\n".join(lines)


def help_of(*command: str) -> str:
    """Return what ``tissuq COMMAND --help`` prints."""
    from workflows.__main__ import main

    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main([*command, "--help"])
    return out.getvalue()


def modules(package: str) -> list[Path]:
    """Return the modules of a package and of the packages in it."""
    return [path for path in sorted((ROOT / package).rglob("*.py")) if not path.stem.startswith("_")]


def parsed(path: Path) -> ast.Module:
    """Return the syntax tree of a module."""
    return ast.parse(path.read_text(encoding="utf-8"))


def module_page(tree: ast.Module, name: str) -> str:
    """Return the page of a module: its docstring and those of its public names."""
    lines = [f"# {name}", "", written(ast.get_docstring(tree) or ""), ""]
    for node in tree.body:
        if isinstance(node, Function) and public(node.name):
            lines += [f"## {node.name}", "", *function(node)]
        elif isinstance(node, ast.ClassDef) and public(node.name):
            bases = ", ".join(ast.unparse(base) for base in node.bases)
            lines += [f"## {node.name}", "", fenced("python", f"class {node.name}{f'({bases})' if bases else ''}"), ""]
            lines += [written(ast.get_docstring(node) or ""), *fields(node), ""]
            for member in node.body:
                if isinstance(member, Function) and public(member.name):
                    lines += [f"### {node.name}.{member.name}", "", *function(member)]
    return "\n".join(lines)


def public(name: str) -> bool:
    """Return whether a name is for others."""
    return not name.startswith("_")


def function(node: Function) -> list[str]:
    """Return the signature and the docstring of a function."""
    returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    arguments = ast.unparse(node.args)
    if len(arguments) > 90:
        arguments = "\n    " + ",\n    ".join(split(node.args)) + ",\n"
    head = "".join(f"@{ast.unparse(one)}\n" for one in node.decorator_list if "property" in ast.unparse(one))
    return [
        fenced("python", f"{head}{node.name}({arguments}){returns}"),
        "",
        written(ast.get_docstring(node) or ""),
        "",
    ]


def split(arguments: ast.arguments) -> list[str]:
    """Return the arguments of a function one by one, as written."""
    plain = [*arguments.posonlyargs, *arguments.args]
    defaults = [None] * (len(plain) - len(arguments.defaults)) + list(arguments.defaults)
    found = [_argument(one, default) for one, default in zip(plain, defaults, strict=True)]
    if arguments.vararg or arguments.kwonlyargs:
        found.append(f"*{ast.unparse(arguments.vararg)}" if arguments.vararg else "*")
    stars = zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)
    return found + [_argument(one, default) for one, default in stars]


def _argument(argument: ast.arg, default: ast.expr | None) -> str:
    return ast.unparse(argument) + (f" = {ast.unparse(default)}" if default is not None else "")


def fields(node: ast.ClassDef) -> list[str]:
    """Return the annotated attributes of a class."""
    lines = [
        ast.unparse(member)
        for member in node.body
        if isinstance(member, ast.AnnAssign) and isinstance(member.target, ast.Name) and public(member.target.id)
    ]
    return ["", fenced("python", "\n".join(lines))] if lines else []


# --- study files -----------------------------------------------------------------------------------------------------


def settings() -> str:
    """Return the reference of all blocks of a study file, from its JSON Schema."""
    from workflows.config.study import schema

    whole = schema()
    blocks = whole["$defs"]
    roots = [one["$ref"].rpartition("/")[2] for one in whole["anyOf"] if "$ref" in one]
    order = roots + sorted((name for name in blocks if name not in roots), key=lambda name: _title(name, blocks[name]))
    lines = [
        "# Blocks of a study file",
        "",
        "What `tissuq schema` says, in words: every block with its keys, what they take, and what they are where they "
        "are left out. A block that says `kind` is chosen by that word. SI units.",
        "",
        "Save the schema as `study.schema.json` and let the first line of a study be `#:schema study.schema.json`: "
        "editors then complete and check it.",
        "",
    ]
    for name in order:
        lines += block(name, blocks)
    return "\n".join(lines)


def _title(name: str, one: dict[str, Any]) -> str:
    return str(one.get("properties", {}).get("kind", {}).get("const", name))


def block(name: str, blocks: dict[str, Any]) -> list[str]:
    """Return heading, description and table of keys of a block."""
    one = blocks[name]
    text, meanings = described(one.get("description", ""))
    title = _title(name, one)
    lines = [
        f"## {title if title == name else f'kind = &quot;{title}&quot;'} {{ #{name.lower()} }}",
        "",
        written(text),
        "",
    ]
    required = one.get("required", ())
    rows = []
    for key, of in one.get("properties", {}).items():
        if key == "kind" and "const" in of:
            continue
        default = "required" if key in required else f"`{json.dumps(of.get('default'), ensure_ascii=False)}`"
        default = "none" if default == "`null`" else default
        meaning = meanings.get(key, of.get("description", "")).replace("|", chr(92) + "|")
        rows.append(f"| `{key}` | {taken(of, blocks)} | {default} | {meaning} |")
    if rows:
        lines += ["| key | takes | default | meaning |", "|---|---|---|---|", *rows, ""]
    return lines


def described(docstring: str) -> tuple[str, dict[str, str]]:
    """Return the text of a docstring before its parameters, and the meaning of each parameter."""
    text, _, rest = re.sub(r"[ \t]+\n", "\n", docstring).partition("\nParameters\n----------\n")
    meanings: dict[str, str] = {}
    for names, meaning in items(rest):
        for name in names.split(","):
            meanings[name.strip()] = prose(" ".join(meaning.split()))
    return text.strip(), meanings


def taken(of: dict[str, Any], blocks: dict[str, Any]) -> str:
    """Say what a key takes; `blocks` are all those of the schema."""
    if "$ref" in of:
        name = of["$ref"].rpartition("/")[2]
        return f"[{_title(name, blocks[name])}](#{name.lower()})"
    for union in ("anyOf", "oneOf"):
        if union in of:
            return " or ".join(dict.fromkeys(taken(one, blocks) for one in of[union] if one.get("type") != "null"))
    if "const" in of:
        return f"`{json.dumps(of['const'], ensure_ascii=False)}`"
    if "enum" in of:
        return " or ".join(f"`{json.dumps(word, ensure_ascii=False)}`" for word in of["enum"])
    kind = of.get("type")
    if kind == "array":
        if "prefixItems" in of:
            members = [taken(one, blocks) for one in of["prefixItems"]]
            return f"[{', '.join(members)}]"
        return f"list of {taken(of.get('items', {}), blocks)}"
    if kind == "object":
        values = of.get("additionalProperties")
        return f"table of {taken(values, blocks)}" if isinstance(values, dict) else "table"
    words = {"integer": "whole number", "number": "number", "boolean": "true or false", "string": "text"}
    limits = {"minimum": "≥", "exclusiveMinimum": "&gt;", "maximum": "≤", "exclusiveMaximum": "&lt;"}
    ends = [f"{sign} {of[name]:g}" for name, sign in limits.items() if name in of]
    return " ".join([words.get(str(kind), "anything"), *ends])


# --- quotations ------------------------------------------------------------------------------------------------------


def quoted(markdown: str) -> str:
    """Replace lines ``{{ docstring MODULE[:NAME] }}``, ``{{ file PATH }}`` and ``{{ starter KIND }}``."""
    kinds: dict[str, Callable[[str], str]] = {"docstring": docstring, "file": _file, "starter": _starter}
    return re.sub(r"^\{\{ (\w+) (\S+) \}\}$", lambda found: kinds[found[1]](found[2]), markdown, flags=re.MULTILINE)


def docstring(place: str) -> str:
    """Return a docstring as Markdown: ``uq.estimators.moments`` of a module, with ``:combine`` of a name in it."""
    module, _, name = place.partition(":")
    tree: Any = parsed(ROOT / f"{module.replace('.', '/')}.py")
    if name:
        tree = next(node for node in tree.body if getattr(node, "name", None) == name)
    return written(ast.get_docstring(tree) or "")


def _file(place: str) -> str:
    path = ROOT / place
    return fenced({".toml": "toml", ".py": "python"}.get(path.suffix, "text"), path.read_text(encoding="utf-8"))


def _starter(kind: str) -> str:
    from workflows.starter import starter

    return fenced("toml", starter(kind)[starter(kind).index("[method]") :])


def fenced(language: str, text: str) -> str:
    """Return text as a block of code."""
    return f"```{language}\n{text.rstrip()}\n```"


def written(text: str) -> str:
    """Return a docstring as Markdown: sections as lists, everything else as it stands."""
    parts = re.split(rf"^({'|'.join(SECTIONS)})\n-{{3,}}\n", text, flags=re.MULTILINE)
    lines = [prose(parts[0].strip())]
    for title, content in zip(parts[1::2], parts[2::2], strict=True):
        lines += ["", f"**{title}**", ""]
        listed = list(items(content))
        if title in {"Notes", "References"} or not listed:
            lines.append(prose(content.strip()))
        lines += [f"- `{name}`: {prose(' '.join(meaning.split()))}" for name, meaning in listed]
    return "\n".join(lines)


def items(content: str) -> Iterator[tuple[str, str]]:
    """Return names and their indented meanings in a section of a docstring."""
    for found in re.finditer(r"^(\S[^\n]*)\n((?:[ \t]+[^\n]*\n?|\n)+)", content + "\n", flags=re.MULTILINE):
        yield found[1].strip(), found[2].strip()


def prose(lines: str) -> str:
    """Keep Markdown from reading formulas as markup; code and indented formulas stay as they are."""
    kept = []
    for line in lines.split("\n"):
        if line.startswith("    "):
            kept.append(line)
            continue
        parts = re.split(r"(``[^`]*``|`[^`]*`)", line)
        for i in range(0, len(parts), 2):
            text = parts[i].replace("<", "&lt;")
            for pattern, tag in ((SUBSCRIPT, "sub"), (SUPERSCRIPT, "sup")):
                text = pattern.sub(lambda found, tag=tag: f"{found[1]}<{tag}>{found[2].strip('{}()')}</{tag}>", text)
            parts[i] = re.sub(r"([*_\[\]])", r"\\\1", text)
        kept.append("".join(parts))
    return "\n".join(kept)
