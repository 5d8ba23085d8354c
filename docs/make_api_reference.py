"""Write docs/api.md, the reference of the Python API, from the docstrings.

python docs/make_api_reference.py
"""

import ast
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import hm_sfm

ROOT = Path(__file__).parents[1]
TARGET = ROOT / "docs" / "api.md"
FIRST = ("types", "config", "errors")
PACKAGES = (
    "geometry", "photos", "pairs", "matching", "keypoints", "colmap", "pipeline", "report", "formats", "export",
    "evaluation",
)  # fmt: skip
"""In the order in which they are worth reading: the way of the data."""
HEADER = """# Python API

Made from the docstrings by `make docs`.

All coordinates are px in COLMAP's frame: the centre of the top-left pixel is (0.5, 0.5). Where images are concerned,
they are those of the stored photo, unrotated and in full size. Examples are in the [python.md](python.md) and in
[pipelines/examples/](../pipelines/examples).
"""

Definition = ast.FunctionDef | ast.ClassDef


def make_reference() -> str:
    """The whole page."""
    public = [f"| `{name}` | [{module}](#{anchor(module)}) |" for name, module in find_public_names()]
    parts = [HEADER, "## hm_sfm\n", "| `from hm_sfm import` | defined in |\n|---|---|", *public]
    return "\n".join([*parts, *map(describe_module, list_modules())])


def find_public_names() -> Iterator[tuple[str, str]]:
    """The names that `hm_sfm` exports, each with the module that defines it."""
    for name in sorted(hm_sfm.__all__):
        yield name, getattr(hm_sfm, name).__module__


def list_modules() -> list[Path]:
    """The files to describe: the modules that come first, then package by package."""
    root = ROOT / "hm_sfm"
    modules = [root / f"{name}.py" for name in FIRST]
    for package in PACKAGES:
        modules += sorted(path for path in (root / package).rglob("*.py") if path.name != "__init__.py")
    return modules


def anchor(module: str) -> str:
    """What GitHub makes of a module's heading."""
    return module.replace(".", "")


def describe_module(path: Path) -> str:
    """Its docstring, then its public functions and classes in the order of the file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    parts = [f"\n## {name}\n", *describe(tree)]
    for node in list_public(tree):
        parts += [f"### {node.name}\n", f"```python\n{write_signature(node)}\n```\n", *describe(node)]
        if isinstance(node, ast.ClassDef):
            parts += [*describe_fields(node), *describe_methods(node)]
    return "\n".join(parts)


def list_public(tree: ast.Module | ast.ClassDef) -> list[Definition]:
    return [node for node in tree.body if isinstance(node, Definition) and not node.name.startswith("_")]


def describe(node: ast.AST) -> list[str]:
    text = ast.get_docstring(node)
    return [escape(text) + "\n"] if text else []


def escape(text: str) -> str:
    """Markdown that shows a docstring as it is, except for what stands in backticks, in lists and in tables."""
    parts = text.split("`")
    parts[::2] = [re.sub(r"([*\[\]])", r"\\\1", part).replace("<", "&lt;") for part in parts[::2]]
    return "`".join(parts)


def write_signature(node: Definition) -> str:
    if isinstance(node, ast.ClassDef):
        bases = ", ".join(map(ast.unparse, node.bases))
        return f"class {node.name}({bases})" if bases else f"class {node.name}"
    arguments = re.sub(r"^(self|cls)(, |$)", "", ast.unparse(node.args))
    return f"{node.name}({arguments})" + (f" -> {ast.unparse(node.returns)}" if node.returns else "")


def describe_fields(node: ast.ClassDef) -> list[str]:
    """The fields of a dataclass, each with the docstring below it."""
    lines = []
    for field, after in zip(node.body, [*node.body[1:], None]):
        if isinstance(field, ast.AnnAssign):
            is_text = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            text = " ".join(inspect.cleandoc(after.value.value).split()) if is_text else ""
            lines.append(f"- `{ast.unparse(field)}`" + (f": {escape(text)}" if text else ""))
    return [*lines, ""] if lines else []


def describe_methods(node: ast.ClassDef) -> list[str]:
    """Methods, with the class before their names; properties look like fields."""
    parts = []
    for method in list_public(node):
        signature = write_signature(method).replace("() ->", ":") if is_property(method) else write_signature(method)
        parts += [f"`{node.name}.{signature}`\n", *describe(method)]
    return parts


def is_property(method: Definition) -> bool:
    return any(ast.unparse(decorator) == "property" for decorator in method.decorator_list)


if __name__ == "__main__":
    TARGET.write_text(make_reference(), encoding="utf-8")
