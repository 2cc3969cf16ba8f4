"""Files and folders of experiments: YAML read strictly, a folder for each task, and folders that can be written."""

import os
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml


class _StrictLoader(yaml.SafeLoader):
    """Refuses a key that stands twice, of which PyYAML takes the last."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        known = set()
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, Hashable):
                continue  # which PyYAML refuses
            if key in known:
                raise yaml.constructor.ConstructorError(None, None, f"{key!r} stands twice", key_node.start_mark)
            known.add(key)
        return super().construct_mapping(node, deep)


def parse_yaml(text: str) -> Any:
    """
    :param text: YAML
    :return: What it says
    :raises yaml.YAMLError: If it is none, or a key stands twice in it
    """
    return yaml.load(text, _StrictLoader)  # a SafeLoader


def read_yaml(name: str, path: Path) -> Any:
    """
    :param name: Of the argument that names the file
    :param path: Of the file
    :return: What it says
    :raises ValueError: If it is no YAML, or a key stands twice in it
    """
    try:
        return parse_yaml(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{name}: {path} is no YAML: {error}") from None


def task_file_name(task: str) -> str:
    """
    :param task: Name of an environment, with its module and namespace if it has them
    :return: Name of it for files and folders, without the module
    """
    return task.rpartition(":")[2].replace("/", "-")


def check_output(folder: Path) -> None:
    """
    :param folder: That is to be written, and made if there is none
    :raises ValueError: If it cannot be
    """
    there = next(each for each in (folder, *folder.resolve().parents) if each.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):
        what = "may not be written" if there.is_dir() else "is no folder"
        raise ValueError(f"--out: {folder} given, but {there} {what}; accepted is a folder, made if there is none")
