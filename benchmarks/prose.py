"""
How long the sentences are: of Markdown pages (paragraphs and list items; not code, tables and headings), of docstrings (not
their fields) and of errors (what ``raise`` says, each ``{...}`` a word). A sentence ends with ``.``, ``!``, ``?`` or ``:``
before a space or the end of its block, and has at least three words. Other packages are read where they are installed.
"""

import argparse
import ast
import re
import statistics
from collections.abc import Iterator
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path

from markdown_it import MarkdownIt

ROOT = Path(__file__).parents[1]
MEDIAN, NINTH = 15, 28
_END = re.compile(r"(?<=[.!?:])[\"')*]*\s+(?=[^a-z])")
# "e.g. Adam" is one sentence
_SHORT = re.compile(r"\b(e\.g|i\.e|cf|vs|et al|Fig|Eq|Sec|approx|resp)\.\s")
_FIELD = re.compile(r"^\s*:(param|return|raises|type|rtype)\b", re.MULTILINE)
_PAGES = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "docs/**/*.md")


def sentences(text: str) -> Iterator[list[str]]:
    """
    :param text: Of one block
    :return: Words of each of its sentences
    """
    for sentence in _END.split(_SHORT.sub(r"\1 ", text)):
        words = [word for word in sentence.split() if any(character.isalnum() for character in word)]
        if len(words) >= 3:
            yield words


def page_blocks(text: str) -> Iterator[str]:
    """
    :param text: Of a Markdown page
    :return: Its paragraphs and list items, code and formulas each as a word
    """
    tokens = MarkdownIt("commonmark").enable("table").parse(text)
    for before, token in pairwise(tokens):
        if token.type == "inline" and before.type == "paragraph_open":
            parts = (_plain(part.type, part.content) for part in token.children or [])
            yield re.sub(r"\$[^$]*\$", "x", "".join(parts))


def _plain(kind: str, content: str) -> str:
    return {"text": content, "code_inline": "code", "softbreak": " ", "hardbreak": " "}.get(kind, "")


def docstring_blocks(text: str) -> Iterator[str]:
    """
    :param text: Of a Python file
    :return: Paragraphs of its docstrings, without fields
    """
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)) and (
            found := ast.get_docstring(node)
        ):
            for block in _FIELD.split(found, maxsplit=1)[0].split("\n\n"):
                if not block.startswith(("    ", ">>>", "|", "..")):
                    yield " ".join(block.split())


def error_blocks(text: str) -> Iterator[str]:
    """
    :param text: Of a Python file
    :return: What its errors say
    """
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args:
            said = node.exc.args[0]
            if isinstance(said, ast.JoinedStr):
                yield "".join(str(part.value) if isinstance(part, ast.Constant) else "x" for part in said.values)
            elif isinstance(said, ast.Constant) and isinstance(said.value, str):
                yield said.value


def row(name: str, blocks: Iterator[str]) -> tuple[str, bool]:
    """
    :param name: Of the row
    :param blocks: Of text
    :return: A row of the table, and whether its sentences are short enough
    """
    lengths = sorted(len(words) for block in blocks for words in sentences(block))
    if len(lengths) < 2:
        return f"{name:<44} {len(lengths):>6}", True
    median, ninth = statistics.median(lengths), statistics.quantiles(lengths, n=10)[8]
    return f"{name:<44} {len(lengths):>6} {median:>7.0f} {ninth:>7.0f} {lengths[-1]:>7}", median <= MEDIAN and ninth <= NINTH


def package_texts(name: str) -> list[str]:
    """
    :param name: Of an installed package
    :return: Its Python files
    """
    spec = find_spec(name)
    if spec is None or not spec.submodule_search_locations:
        raise ValueError(f"others: {name!r} given; accepted are packages that are installed")
    return [path.read_text() for path in sorted(Path(spec.submodule_search_locations[0]).rglob("*.py"))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pages", action="store_true", help="a row for each page")
    parser.add_argument("--longest", type=int, default=0, help="show so many of the longest sentences of the pages")
    parser.add_argument("--others", nargs="*", default=["stable_baselines3"], help="packages to set beside")
    options = parser.parse_args()
    pages = {str(path.relative_to(ROOT)): path.read_text() for pattern in _PAGES for path in sorted(ROOT.glob(pattern))}
    own = [path.read_text() for path in sorted((ROOT / "sb3_ddiffpg").rglob("*.py"))]
    print(f"{'':<44} {'number':>6} {'median':>7} {'9 of 10':>7} {'longest':>7}   (asked: {MEDIAN}, {NINTH})")
    rows = [("pages", (block for text in pages.values() for block in page_blocks(text)))]
    if options.pages:
        rows += [(f"  {name}", page_blocks(text)) for name, text in pages.items()]
    for name, texts in {"sb3_ddiffpg": own, **{other: package_texts(other) for other in options.others}}.items():
        rows.append((f"{name}: docstrings", (block for text in texts for block in docstring_blocks(text))))
        rows.append((f"{name}: errors", (block for text in texts for block in error_blocks(text))))
    for name, blocks in rows:
        line, short = row(name, blocks)
        print(line + ("" if short else "   too long"))
    found = [
        (len(words), name, " ".join(words))
        for name, text in pages.items()
        for b in page_blocks(text)
        for words in sentences(b)
    ]
    for length, name, sentence in sorted(found, reverse=True)[: options.longest]:
        print(f"\n{length} words, {name}: {sentence}")


if __name__ == "__main__":
    main()
