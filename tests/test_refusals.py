"""Commands that refuse given views or options say why in one line, before they make a folder. Nothing of this needs Blender."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from bbfit.checks import InputError
from bbfit.cli import main
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import export
from bbfit.fitting.config import FitConfig
from bbfit.fitting.loop import fit
from bbfit.fitting.requirements import check_device
from bbfit.images import write_png
from bbfit.pipeline import RunConfig, run
from bbfit.views.dataset import ViewDataset
from tests.geometry.test_cloud import small_cloud

DATA = Path(__file__).resolve().parents[1] / "data"


@pytest.mark.parametrize("command", ["fit", "run"])
@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--device", "cuda:99"], "device: 'cuda:99' is not available"),
        (["--device", "meta"], "device: 'meta' is not available; use cpu, or cuda on a machine with a GPU"),
        (["--device", "meta", "--backend", "reference"], "device: 'meta' is not available"),
        (["--device", "nonsense"], "device: 'nonsense' is not available"),
        (["--billboards", "2", "--vertices", "8"], "billboards: 2 are requested in addition to a budget; leave out one of them"),
        (["--max-texels", "900", "--vertices", "8"], "max_texels: 900 are requested in addition to a budget; leave them out"),
        (["--preset", "thesis", "--auto"], "preset: 'thesis' cannot be combined with a budget"),
        (["--sides", "two", "--vertices", "4"], "vertices: 4 are too few for one billboard"),
        (["--sides", "two", "--texels", "1"], "texels: 1 are too few for 2 textures"),
        (["--alpha", "blend", "--split", "--vertices", "32"], "split: its pieces have more vertices than a budget of vertices allows"),
        (["--light", "maps", "--material", "unlit"], "material: the cloud has maps, whose colors contain no light"),
        (["--sides", "pair"], "sides: pairs need an even placement"),
        (["--max-texels", "3"], "max_texels: 3 are too few for 384 textures"),
        (["--port", "65536"], "port: expected a value in [0, 65535], got 65536"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_options_make_no_folder(
    command: str, options: list[str], says: str, views_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, str(views_folder), "--out", str(tmp_path / "new" / "out"), *options]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith(f"bbfit: {says}")
    assert not list(tmp_path.iterdir())


def copied(views_folder: Path, folder: Path) -> Path:
    return Path(shutil.copytree(views_folder, folder))


def keep(views: Path, train: list[int], test: list[int]) -> None:
    """Keep some frames of each split."""
    for name, indices in (("train", train), ("test", test)):
        path = views / f"transforms_{name}.json"
        content = json.loads(path.read_text())
        content["frames"] = [content["frames"][index] for index in indices]
        path.write_text(json.dumps(content))


def refused(views: Path, said: str, *, config: RunConfig | None = None) -> None:
    out = views.parent / "new" / "out"
    with pytest.raises(InputError, match=said) as caught:
        run(views, out, config, on_progress=lambda *event: pytest.fail("work was begun"))
    assert "\n" not in str(caught.value) and not out.parent.exists()


def test_views_that_do_not_show_where_the_tree_is(views_folder: Path, tmp_path: Path) -> None:
    views = copied(views_folder, tmp_path / "views")
    keep(views, [0], [0])
    said = "views: there is a single training view, so it is not known where the tree is; give views from around the tree"
    refused(views, said)
    with pytest.raises(InputError, match=said):
        fit(ViewDataset.load(views), FitConfig(steps=1))


def test_too_few_views_for_a_budget(views_folder: Path, tmp_path: Path) -> None:
    from bbfit.budget.config import BudgetConfig

    views = copied(views_folder, tmp_path / "views")
    keep(views, [0, 1, 2, 3], [0])
    said = "views: 4 training views are too few for a validation split; give at least 5"
    refused(views, said, config=RunConfig(budget=BudgetConfig(auto=True)))


@pytest.mark.parametrize("split", ["train", "test"])
def test_pictures_that_cannot_be_used(views_folder: Path, tmp_path: Path, split: str) -> None:
    views = copied(views_folder, tmp_path / "views")
    name = json.loads((views / f"transforms_{split}.json").read_text())["frames"][-1]["file_path"] + ".png"
    write_png(views / name, np.zeros((40, 48, 4), np.uint8))
    refused(views, "is fully transparent; render it anew or take it out")
    (views / name).write_bytes((views_folder / name).read_bytes()[:-5])
    refused(views, "cut short")


def test_meshes_that_cannot_be_used(views_folder: Path, tmp_path: Path) -> None:
    views = copied(views_folder, tmp_path / "views")
    (tmp_path / "tree.fbx").write_bytes(b"Kaydara FBX Binary")
    for placement in ("clusters", "even"):
        config = RunConfig(tree=tmp_path / "tree.fbx", fit=FitConfig(placement=placement))
        refused(views, r"tree: only Blender can read the triangles of .*tree\.fbx; give one of \.glb", config=config)
    config = RunConfig(tree=DATA / "tree.glb")
    with pytest.raises(InputError, match="is not where the views show a tree"):
        run(views, tmp_path / "new" / "out", config)
    assert not (tmp_path / "new").exists()


def test_evaluate_and_export_make_no_folder(
    views_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    cloud = tmp_path / "cloud.safetensors"
    even = FitConfig(billboards=1, placement="even", steps=1)
    fit(ViewDataset.load(views_folder), even).cloud.save(cloud)
    (tmp_path / "folder.glb").mkdir()
    monkeypatch.setattr("bbfit.exporting.config.ktx2_missing", lambda: "install it")
    for arguments, says in (
        (
            ["evaluate", cloud, views_folder, "--out", tmp_path / "new" / "m.json", "--tree", tmp_path / "none.glb"],
            "none.glb does not exist",
        ),
        (["evaluate", cloud, views_folder, "--out", tmp_path / "new" / "m.json", "--textures", "ktx2"], "is not installed; install it"),
        (["evaluate", cloud, views_folder, "--out", tmp_path], "is a folder"),
        (["export", cloud, "--out", tmp_path / "folder.glb"], "is a folder"),
        (["export", tmp_path / "none.safetensors", "--out", tmp_path / "model.stl"], ".glb or .obj"),
    ):
        before = sorted(tmp_path.rglob("*"))
        assert main([str(part) for part in arguments]) == 2
        assert says in capsys.readouterr().err and sorted(tmp_path.rglob("*")) == before


def test_a_missing_encoder_stops_every_command_before_its_work(
    views_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bbfit.exporting.config.ktx2_missing", lambda: "install it")
    for work in ("bbfit.pipeline.views_stage", "bbfit.pipeline.grow_stage", "bbfit.pipeline.fit_stage", "bbfit.lod.views_stage"):
        monkeypatch.setattr(work, lambda *_: pytest.fail("work was begun"))
    cloud, tree, out = tmp_path / "cloud.safetensors", str(DATA / "tree.glb"), str(tmp_path / "new" / "out")
    small_cloud().save(cloud)
    for arguments in (
        ["run", "--out", out],
        ["run", tree, "--out", out],
        ["run", str(views_folder), "--out", out],
        ["fit", str(views_folder), "--out", out],
        ["lod", tree, "--out", out + ".glb"],
        ["compare", tree, "--out", out],
        ["sweep", "--species", "acer", "--out", out],
        ["evaluate", str(cloud), str(views_folder), "--out", out + ".json"],
        ["export", str(cloud), "--out", str(tmp_path / "model.glb")],
    ):
        assert main([*arguments, "--textures", "ktx2"]) == 2, arguments
        assert "the package alktx2, is not installed; install it" in " ".join(capsys.readouterr().err.split()), arguments
        assert not Path(out).parent.exists() and not (tmp_path / "model.glb").exists()


def test_a_missing_encoder_stops_the_library_before_its_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bbfit.exporting.config.ktx2_missing", lambda: "install it")
    monkeypatch.setattr("bbfit.exporting.model.cloud_cards", lambda *_, **__: pytest.fail("work was begun"))
    with pytest.raises(InputError, match="alktx2, is not installed; install it"):
        export(small_cloud(), tmp_path / "model.glb", ExportConfig(textures="ktx2"))


def test_a_full_disk_stops_runs_and_exports_before_their_work(
    views_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr("bbfit.outputs.shutil.disk_usage", lambda _: usage._replace(free=10))
    refused(views_folder, "is on a disk with 10 free bytes, and 67,108,864 may be needed; choose another output folder or free the disk")
    small_cloud().save(tmp_path / "cloud.safetensors")
    assert main(["export", str(tmp_path / "cloud.safetensors"), "--out", str(tmp_path / "model.glb")]) == 2
    assert "on a disk with 10 free bytes" in " ".join(capsys.readouterr().err.split())
    assert [path.name for path in tmp_path.iterdir() if path.suffix == ".glb"] == []


def test_a_device_is_returned_and_kernels_need_theirs(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    assert check_device(FitConfig(device="cpu")) == torch.device("cpu")
    zeros = torch.zeros
    monkeypatch.setattr(torch, "zeros", lambda *shape, device: zeros(*shape))  # a machine with any device
    with pytest.raises(InputError, match="device: the kernels do not run on 'mps'; use cpu, cuda, or --backend reference"):
        check_device(FitConfig(device="mps"))
    assert check_device(FitConfig(device="mps", backend="reference")).type == "mps"
