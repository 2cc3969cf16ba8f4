"""
The directive ``public-api``: what a module offers, from signatures and docstrings. They are read and never imported, so that
the site needs neither torch nor a simulator.

An object that several modules offer is described once: where the longest module path lists it, under its shortest name. The
other lists lead there.
"""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import griffe
from docutils import nodes
from docutils.statemachine import StringList
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util.docutils import SphinxDirective

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "sb3_ddiffpg"
_LISTS = re.compile(r"^\.\. public-api:: (\S+)\n\n((?:   \S+\n)+)", re.MULTILINE)


def listed(folder: Path) -> list[tuple[str, str]]:
    """
    :param folder: Of the API pages
    :return: Module and name of each entry of their lists; a name may go through a module, ``settings.ModeSettings``
    """
    texts = [page.read_text() for page in sorted(folder.glob("*.rst"))]
    return [(module, name) for text in texts for module, names in _LISTS.findall(text) for name in names.split()]


class Package:
    """
    What the pages say of the package.

    :param source: Folder in which the package lies
    :param pages: Folder of the API pages
    """

    def __init__(self, source: Path, pages: Path) -> None:
        self.top = griffe.load(PACKAGE, search_paths=[source], resolve_aliases=True)
        # By what an object is called where it is made, all lists that name it
        self.paths: dict[str, list[tuple[str, str]]] = {}
        for module, name in listed(pages):
            self.paths.setdefault(self.target(module, name).path, []).append((module, name))

    def target(self, module: str, name: str) -> Any:
        """
        :param module: That offers it
        :param name: By which it does
        :return: The object itself
        :raises KeyError: If there is none
        """
        path = f"{module}.{name}".removeprefix(PACKAGE).lstrip(".")
        found = self.top[path]
        try:
            return found.final_target if found.is_alias else found
        except griffe.AliasResolutionError:  # of another package, which is not read
            return found

    def described_at(self, path: str) -> tuple[str, str]:
        """
        :param path: Of an object that pages list
        :return: The list that describes it
        """
        return max(self.paths[path], key=lambda pair: (pair[0].count("."), pair[0]))

    def shown_as(self, path: str) -> tuple[str, str]:
        """
        :param path: Of an object that pages list
        :return: Module and name under which it is described
        """
        module, name = min(self.paths[path], key=lambda pair: (".".join(pair).count("."), len(".".join(pair))))
        *inner, name = name.split(".")
        return ".".join([module, *inner]), name

    def names(self) -> dict[str, list[str]]:
        """
        :return: What a text may call an object, and which objects that may be. A single word in small letters is no name
        """
        called: dict[str, list[str]] = {}
        for path in self.paths:
            full = ".".join(self.shown_as(path))
            name = full.rpartition(".")[2]
            for each in {full, path, *([name] if re.search("_|[A-Z].*[a-z]", name) else [])}:
                called.setdefault(each, []).append(full)
        return called


def default(value: Any) -> str:
    """
    :param value: Of a parameter, as it is written
    :return: What it is for a caller: of a setting, without what is accepted
    """
    if isinstance(value, griffe.ExprCall) and str(value.function) == "setting":
        return str(value.arguments[0])
    return re.sub(r"^\(lambda: (.*)\)\(\)$", r"\1", str(value))  # of a dataclass, griffe's way to write a default_factory


def signature(parameters: Iterable[Any], returns: Any = None) -> str:
    """
    :param parameters: Of a function or class
    :param returns: What it returns, None where nothing is said
    :return: The signature, without ``self`` and what is private
    """
    parts, kinds = [], griffe.ParameterKind
    star = False
    only_by_position = False
    for index, each in enumerate(parameters):
        if (index == 0 and each.name in ("self", "cls")) or each.name.startswith("_"):
            continue
        if only_by_position and each.kind is not kinds.positional_only:
            parts.append("/")
        only_by_position = each.kind is kinds.positional_only
        if each.kind is kinds.keyword_only and not star:
            parts.append("*")
            star = True
        star = star or each.kind is kinds.var_positional
        text = {kinds.var_positional: "*", kinds.var_keyword: "**"}.get(each.kind, "") + each.name.lstrip("*")
        if each.annotation is not None:
            text += f": {each.annotation}"
        if each.default is not None and each.kind not in (kinds.var_positional, kinds.var_keyword):
            text += f" = {default(each.default)}"
        parts.append(text)
    return f"({', '.join(parts)})" + (f" -> {returns}" if returns is not None else "")


def comment(found: Any) -> str:
    """
    :param found: An attribute
    :return: The ``#:`` comment above it
    """
    lines = found.lines_collection[found.filepath][: found.lineno - 1]
    said: list[str] = []
    while lines and lines[-1].strip().startswith("#:"):
        said.insert(0, lines.pop().strip().removeprefix("#:").strip())
    return "\n".join(said)


def words(found: Any) -> str:
    """
    :param found: An object
    :return: Its docstring, or the comment that stands for one
    """
    if found.docstring is not None:
        return found.docstring.value
    return comment(found) if found.is_attribute and found.lineno else ""


def first_words(found: Any) -> str:
    """
    :param found: An object
    :return: The first sentence of what it says of itself, "" if there is none
    """
    text = re.split(r"(?<=[.:])\s|\n\n|(?:^|\n):", words(found), maxsplit=1)[0]
    return text.replace("\n", " ").rstrip(":").strip()


def origin(alias: Any) -> str:
    """
    :param alias: That leads out of the package
    :return: Where to
    """
    try:
        return origin(alias.target)
    except griffe.AliasResolutionError as error:
        return alias.target_path if error.alias is alias else origin(error.alias)


class PublicApi(SphinxDirective):
    """Describes the named objects of a module."""

    required_arguments = 1
    has_content = True

    def run(self) -> list[nodes.Node]:
        package: Package = self.env.app.public_api
        module = self.arguments[0]
        self.lines = StringList()
        elsewhere, foreign = [], []
        for name in self.content:
            found = package.target(module, name)
            if found.is_alias:
                foreign.append((name, found))
                continue
            self.env.note_dependency(str(found.filepath))
            if package.described_at(found.path) != (module, name):
                elsewhere.append((name, found))
                continue
            shown_module, shown_name = package.shown_as(found.path)
            options = [f":module: {shown_module}"]
            if found.path != f"{shown_module}.{shown_name}":
                options.append(f":canonical: {found.path}")
            self.describe(package, found, shown_name, options, "")
        for name, found in elsewhere:
            role = "class" if found.is_class else "func" if found.is_function else "data"
            link = f":py:{role}:`{name} <{'.'.join(package.shown_as(found.path))}>`"
            self.add(f"* {link}: {first_words(found)}".rstrip(": "), found, "")
        for name, found in foreign:
            self.add(f"* ``{name}``: ``{origin(found)}``, handed on", found.parent, "")
        node = nodes.container()
        self.state.nested_parse(self.lines, self.content_offset, node)
        return node.children

    def add(self, text: str, found: Any, indent: str, first_line: int = 0) -> None:
        for number, line in enumerate(text.split("\n")):
            self.lines.append(f"{indent}{line}" if line.strip() else "", str(found.filepath), first_line + number)

    def describe(self, package: Package, found: Any, name: str, options: list[str], indent: str) -> None:
        """
        Add the description of an object.

        :param package: All that is described
        :param found: The object
        :param name: Under which
        :param options: Of the directive that describes it
        :param indent: Of the description
        """
        if found.is_class:
            kind, head = "class", name + signature(found.parameters)
        elif found.is_function:
            kind = "method" if indent else "function"
            head = name + signature(found.parameters, found.returns)
            for label in ("classmethod", "staticmethod", "abstractmethod"):
                if label in found.labels:
                    options.append(f":{label}:")
        else:
            kind, head = ("attribute" if indent else "data"), name
            if "property" in found.labels or "cached" in found.labels:
                kind = "property"
            elif found.value is not None and len(str(found.value)) < 60:
                options.append(f":value: {found.value}")
            if found.annotation is not None:
                options.append(f":type: {found.annotation}")
        self.add(f".. py:{kind}:: {head}", found, indent)
        inner = indent + "   "
        for option in options:
            self.add(option, found, inner)
        self.add("", found, "")
        self.add(words(found), found, inner, found.docstring.lineno - 1 if found.docstring else 0)
        self.add("", found, "")
        if found.is_class:
            bases = [each for each in found.mro() if each.path in package.paths]
            if bases:
                links = [f":py:class:`{'.'.join(package.shown_as(each.path))}`" for each in bases]
                self.add(f"Bases: {', '.join(links)}.", found, inner)
                self.add("", found, "")
            for member, member_name in members(found, package):
                self.describe(package, member, member_name, [], inner)


def members(found: Any, package: Package) -> Iterator[tuple[Any, str]]:
    """
    :param found: A class
    :param package: All that is described
    :return: Its public members that say what they are, with their names; also what it has of classes that are not described
    """
    seen: set[str] = set()
    for each in [found, *found.mro()]:
        if each is not found and each.path in package.paths:
            seen.update(each.members)  # described there, with what it has of others
            continue
        for name, member in each.members.items():
            if name in seen or name.startswith("_"):
                continue
            seen.add(name)
            if not member.is_alias and not member.is_class and words(member):
                yield member, name


class NamesLead(SphinxPostTransform):
    """A public name in running text leads to its description."""

    default_priority = 5

    def run(self, **kwargs: Any) -> None:
        names: dict[str, list[str]] = self.env.app.public_api.names()
        for node in list(self.document.findall(nodes.literal)):
            found = names.get(node.astext().removesuffix("()"), [])
            inside = node.parent
            while inside is not None and not isinstance(inside, nodes.reference | nodes.title | addnodes.pending_xref):
                inside = inside.parent
            if len(found) != 1 or inside is not None or "xref" in node["classes"]:
                continue
            link = addnodes.pending_xref("", refdomain="py", reftype="obj", reftarget=found[0], refexplicit=True)
            link["refdoc"], link["refwarn"] = self.env.docname, True
            node.replace_self(link)
            link += node


def read_package(app: Sphinx) -> None:
    """
    :param app: That builds the site
    """
    app.public_api = Package(ROOT, ROOT / "docs" / "api")


def setup(app: Sphinx) -> dict[str, Any]:
    """
    :param app: That builds the site
    :return: What Sphinx asks of an extension
    """
    app.connect("builder-inited", read_package)
    app.add_directive("public-api", PublicApi)
    app.add_post_transform(NamesLead)
    return {"parallel_read_safe": False, "parallel_write_safe": True}
