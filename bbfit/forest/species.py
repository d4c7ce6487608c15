"""Which trees of a library stand for a species of a register: the same one, or the nearest by a table."""

from __future__ import annotations

import csv
import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from bbfit.checks import fail
from bbfit.inputs import reading
from bbfit.library.manifest import Library

# Genera of conifers and of broadleaf trees with their common names in English, German, French and Dutch, by their habit.
_HABITS: Mapping[str, Mapping[str, str]] = {
    "conical conifer": {
        "abies": "fir tanne sapin zilverspar",
        "picea": "spruce fichte epicea spar",
        "pseudotsuga": "douglasfir douglas douglasie",
        "larix": "larch larche laerche meleze lariks",
        "cedrus": "cedar zeder cedre ceder",
        "metasequoia": "dawnredwood urweltmammutbaum metasequoia",
        "sequoiadendron": "sequoia mammutbaum",
        "taxodium": "baldcypress sumpfzypresse",
        "thuja": "arborvitae lebensbaum thuya levensboom",
        "chamaecyparis": "falsecypress scheinzypresse",
        "tsuga": "hemlock hemlocktanne",
        "cupressus": "cypress zypresse cypres cipres",
        "juniperus": "juniper wacholder genevrier jeneverbes",
    },
    "spreading conifer": {"pinus": "pine kiefer pin den", "taxus": "yew eibe if taxus"},
    "round broadleaf": {
        "acer": "maple sycamore ahorn erable esdoorn",
        "quercus": "oak eiche chene eik",
        "fagus": "beech buche hetre beuk",
        "tilia": "lime linden linde tilleul",
        "aesculus": "horsechestnut buckeye rosskastanie kastanie marronnier paardenkastanje",
        "platanus": "plane planetree platane plataan",
        "fraxinus": "ash esche frene",
        "ulmus": "elm ulme orme iep olm",
        "castanea": "chestnut esskastanie edelkastanie chataignier",
        "carpinus": "hornbeam hainbuche charme haagbeuk",
        "juglans": "walnut walnuss noyer walnoot",
        "robinia": "locust robinie robinier",
        "gleditsia": "honeylocust gleditschie fevier",
        "liquidambar": "sweetgum amberbaum copalme",
        "celtis": "hackberry nettletree zurgelbaum micocoulier",
        "sophora": "pagodatree schnurbaum",
        "styphnolobium": "japanesepagodatree",
        "zelkova": "zelkova zelkove",
        "ailanthus": "treeofheaven gotterbaum ailante",
        "liriodendron": "tuliptree tulpenbaum tulipier tulpenboom",
        "corylus": "hazel hasel baumhasel noisetier hazelaar",
    },
    "light broadleaf": {
        "betula": "birch birke bouleau berk",
        "populus": "poplar aspen cottonwood pappel espe peuplier populier",
        "salix": "willow weide saule wilg",
        "alnus": "alder erle aulne els",
        "ginkgo": "ginkgo",
    },
    "small broadleaf": {
        "malus": "apple crabapple apfel zierapfel pommier appel",
        "prunus": "cherry plum kirsche pflaume cerisier prunier kers pruim",
        "pyrus": "pear birne poirier peer",
        "crataegus": "hawthorn weissdorn aubepine meidoorn",
        "sorbus": "rowan whitebeam eberesche mehlbeere sorbier lijsterbes",
        "amelanchier": "serviceberry felsenbirne amelanchier",
        "magnolia": "magnolia magnolie",
        "cercis": "redbud judasbaum gainier judasboom",
        "cornus": "dogwood hartriegel cornouiller kornoelje",
    },
}
_GENERA = {genus: habit for habit, genera in _HABITS.items() for genus in genera}
_COMMON = {name: genus for genera in _HABITS.values() for genus, names in genera.items() for name in names.split()}
# Common names that end compound words in German and Dutch, such as Spitzahorn; the longest first.
_ENDINGS = sorted((name for name in _COMMON if len(name) >= 4), key=len, reverse=True)
Likeness = str
"""How near a tree is: species, table, genus, habit, kind or any."""


@dataclass(frozen=True)
class Match:
    """The trees that stand for a species."""

    trees: tuple[int, ...]
    """Indices into ``Library.trees``."""
    likeness: Likeness
    """How near they are: ``species`` (the same), ``table`` (by the user's table), ``genus``, ``habit`` (such as conical conifers), ``kind``
    (conifers or broadleaf trees), or ``any`` (nothing is known)."""


def nearest_trees(library: Library, name: str, table: Mapping[str, str]) -> Match:
    """The trees of a library that stand for a species of a register.

    ``table`` maps names of species to those of species or trees of the library (:func:`read_species_table`).
    """
    given = table.get(_plain(name))
    if given is not None:
        return Match(named_trees(library, given, "species_table"), "table")
    plain = _plain(name)
    same = [number for number, tree in enumerate(library.trees) if plain and plain in (_plain(tree.name), _plain(tree.species or ""))]
    if same:
        return Match(tuple(same), "species")
    genera = [genus_of(tree.species or tree.name) for tree in library.trees]
    genus = genus_of(name)
    habit = _GENERA.get(genus or "")
    kind = habit and habit.split()[-1]
    habits = [_GENERA.get(each or "") for each in genera]
    for likeness, alike in (
        ("genus", [genus is not None and each == genus for each in genera]),
        ("habit", [habit is not None and each == habit for each in habits]),
        ("kind", [kind is not None and each is not None and each.split()[-1] == kind for each in habits]),
    ):
        if any(alike):
            return Match(tuple(number for number, fits in enumerate(alike) if fits), likeness)
    return Match(tuple(range(len(library.trees))), "any")


def named_trees(library: Library, name: str, option: str) -> tuple[int, ...]:
    """The trees with a name or of a species, as indices. Raises InputError, which names the ``option``, if there are none."""
    plain = _plain(name)
    found = tuple(number for number, tree in enumerate(library.trees) if plain in (_plain(tree.name), _plain(tree.species or "")))
    if not found:
        known = sorted({tree.species or tree.name for tree in library.trees})
        fail(option, f"the library has no tree and no species {name}", f"it has {', '.join(known[:40])}")
    return found


def genus_of(name: str) -> str | None:
    """The genus of a species by its botanical or common name, in lower case, or ``None``."""
    words = _words(name)
    for word in words:
        if word in _GENERA:
            return word
    joined = "".join(words)
    for text in [joined, *words]:
        if text in _COMMON:
            return _COMMON[text]
    for word in words:
        ending = next((ending for ending in _ENDINGS if word.endswith(ending)), None)
        if ending is not None:
            return _COMMON[ending]
    return None


def read_species_table(path: Path, library: Library) -> dict[str, str]:
    """The user's table: names of species, prepared for comparison, and what of the library stands for each.

    The first two columns count. A first row whose second cell is no tree and no species of the library is a header. Raises InputError with
    the row if a tree is not in the library.
    """
    table, known = dict[str, str](), {_plain(text) for tree in library.trees for text in (tree.name, tree.species or "") if text}
    with reading("species_table", path, "give a table with two columns"), path.open(encoding="utf-8-sig", newline="") as file:
        head = file.readline(1 << 16)
        file.seek(0)
        for number, cells in enumerate(csv.reader(file, delimiter=max(",;\t", key=head.count)), 1):
            row: Sequence[str] = [cell.strip() for cell in cells]
            if not any(row):
                continue
            if len(row) < 2 or not row[0] or not row[1]:
                fail("species_table", f"{path}, row {number} has no two columns", "give a species and a tree of the library")
            if _plain(row[1]) in known:
                table[_plain(row[0])] = row[1]
            elif number > 1:
                fail("species_table", f"{path}, row {number}, column 2: the library has no tree and no species {row[1]:.60}", "correct it")
    return table


def _words(name: str) -> list[str]:
    letters = unicodedata.normalize("NFKD", name.replace("ß", "ss").casefold())
    bare = "".join(letter for letter in letters if not unicodedata.combining(letter))
    return re.findall(r"[a-z0-9]+", bare)


def _plain(name: str) -> str:
    return "".join(_words(name))
