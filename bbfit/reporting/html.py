"""``report.html``: the results of a run in one file that needs no network."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from bbfit.evaluation.backgrounds import BACKGROUNDS, mean_flip_map
from bbfit.evaluation.report import Report, ViewScore
from bbfit.evaluation.scoring import held_out
from bbfit.exporting.encoders import encode_webp
from bbfit.exporting.model import ShippedModel
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.extent import shown_bounds
from bbfit.images import shrunk, to_bytes, unpremultiply
from bbfit.model_files import generator
from bbfit.reporting.charts import (
    FEW,
    MEASURES,
    azimuth_chart,
    billboard_color,
    loss_chart,
    plan_chart,
    sizes_chart,
    times_chart,
    worst_views,
)
from bbfit.reporting.plots import magma, spread_views
from bbfit.reporting.suns import UnderSun, under_suns
from bbfit.reporting.text import percent
from bbfit.reporting.threejs import drawing_script, library_page, page_light
from bbfit.views.lit import LitViews
from bbfit.views.view_set import ViewSet

# The most held-out views with pictures, besides the worst ones, and the largest width of a picture in pixels.
_MAX_VIEWS, _MAX_WIDTH = 36, 512


@dataclass(frozen=True)
class RunFacts:
    """A run's options, seeds, versions and losses."""

    source: str
    """Name of the source: a file, a folder or a species. It may contain any characters; the page escapes it."""
    options: Mapping[str, Mapping[str, Any]]
    """Every option of each stage, resolved."""
    defaults: Mapping[str, Mapping[str, Any]]
    """The default of every option of each stage."""
    seeds: Mapping[str, int]
    """Seed of each stage."""
    versions: Mapping[str, str | None]
    """Versions of bbfit and of the libraries that it used."""
    losses: Sequence[float]
    """Loss of every step of the fit."""
    pareto: bytes | None = None
    """The picture of a budget's trials (PNG), if there was a budget."""


def report_page(report: Report, model: ShippedModel, views: ViewSet, facts: RunFacts, glb: bytes, lit: LitViews | None = None) -> str:
    """The report on V held-out ``views`` as HTML. The page loads nothing from elsewhere, and names that users chose are escaped.

    It shows the key figures beside the original's, held-out views (target, result, FLIP map) with a slider and over the background that the
    reader chooses, every measure by azimuth with the worst views, the model in 3D, with a sun to drag if it has maps, textures and a plan
    of the billboards, the quality from a distance, the loss, and the options. Of the views it shows the worst ones and at most 36 others,
    no wider than 512 pixels.

    ``glb`` is the model for the 3D view, with pictures that browsers read (PNG or WebP). ``lit`` are the held-out views of the report's
    score under light: the page shows one camera under three suns. Raises InputError if a view cannot be read, or if there are none.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    cloud, worst = model.cloud, _worst(report.views)
    angles = np.array([(view.azimuth_degrees, view.elevation_degrees) for view in report.views])
    shown = sorted({*spread_views(angles, _MAX_VIEWS), *(entry["index"] for entry in worst)}, key=lambda index: (*angles[index], index))
    layered = not report.alpha.tested and not model.config.split
    azimuth, plan = azimuth_chart(report.views), plan_chart(cloud)
    environment = Environment(
        loader=PackageLoader("bbfit.reporting", "page"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"count": _count, "share": _share, "figure": _figure}
    own = files("bbfit.reporting") / "page"
    return environment.get_template("report.html").render(
        title=f"{report.subject.tree or facts.source} as {len(cloud)} {'billboard' if len(cloud) == 1 else 'billboards'}",
        generator=generator(),
        style=Markup((own / "report.css").read_text(encoding="utf-8")),
        script=Markup((own / "report.js").read_text(encoding="utf-8")),
        report=report,
        cloud=cloud,
        views=[_view(model, views, report.views[index], index) for index in shown],
        worst=worst,
        backgrounds={name: "rgb({:g}% {:g}% {:g}%)".format(*(100 * value for value in color)) for name, color in BACKGROUNDS.items()},
        first=shown.index(sorted(shown, key=lambda index: report.views[index].measures.over.mean.flip)[len(shown) // 2]),  # a typical one
        azimuth=Markup(azimuth.svg),
        plan=Markup(plan.svg),
        marks={**azimuth.marks, **plan.marks},
        sizes=Markup(sizes_chart(report.sizes).svg) if report.sizes else None,
        loss=Markup(loss_chart(facts.losses).svg),
        times=Markup(times_chart(report.seconds).svg) if report.seconds else None,
        billboards=_billboards(cloud),
        many=len(cloud) > FEW,
        library=library_page(),
        drawing=Markup(drawing_script()),
        glb=base64.b64encode(glb).decode(),
        bounds=shown_bounds(cloud, spared=0.005).tolist(),
        layered=layered,
        light=None if cloud.light is None else page_light(cloud.light),
        suns=[] if lit is None or report.light is None else [_under_sun(each) for each in under_suns(model, lit, report.light.views)],
        costs=[("vertices", report.vertices), ("file, bytes", report.bytes)],
        facts=facts,
        changed=_changed(facts),
        pareto=None if facts.pareto is None else _data("image/png", facts.pareto),
    )


def _least_seen(cloud: BillboardCloud) -> float:
    """The alpha from which a texel counts as opaque."""
    return cloud.alpha.cutoff if cloud.alpha.tested else 0.5


def _view(model: ShippedModel, views: ViewSet, score: ViewScore, index: int) -> dict[str, Any]:
    """The pictures and measures of a held-out view."""
    target, result = held_out(model.draw, views, index)
    error = mean_flip_map(target, result)
    size = _shown_size(target)
    mapped = magma(shrunk(torch.from_numpy(error)[..., None], *size)[..., 0].numpy())
    opaque = np.full((*mapped.shape[:2], 1), 255, np.uint8)
    over = score.measures.over
    return {
        "index": index,
        "name": score.name,
        "azimuth": score.azimuth_degrees,
        "elevation": score.elevation_degrees,
        **asdict(over.mean),
        "over": {name: getattr(over, name).psnr for name in BACKGROUNDS},
        "iou": score.measures.rgba.iou,
        "width": size[0],
        "height": size[1],
        "pictures": [_picture(target), _picture(result), _webp(np.concatenate([mapped, opaque], -1))],
    }


def _under_sun(shown: UnderSun) -> dict[str, Any]:
    """A column of the strip under other suns."""
    return {
        **asdict(shown.score),
        "size": _shown_size(shown.target),
        "pictures": [_picture(shown.target), _picture(shown.image)],
    }


def _shown_size(picture: torch.Tensor) -> tuple[int, int]:
    """Width and height of a picture, [H, W, 4], in the page."""
    height, width = picture.shape[:2]
    return min(width, _MAX_WIDTH), max(1, height * min(width, _MAX_WIDTH) // width)


def _picture(picture: torch.Tensor) -> str:
    """A picture, premultiplied RGBA [H, W, 4], as the page shows it."""
    return _webp(to_bytes(unpremultiply(shrunk(picture, *_shown_size(picture)))))


def _worst(views: Sequence[ViewScore]) -> list[dict[str, Any]]:
    """The worst view by each measure and the three views with the largest FLIP, with their measures."""
    worst = worst_views(views)
    most = sorted(range(len(views)), key=lambda index: -views[index].measures.over.mean.flip)[:3]
    titles = {name: title.removesuffix(", dB") for name, title, _ in MEASURES}
    return [
        {
            "index": index,
            "by": [(titles[name], getattr(views[index].measures.over.mean, name), worst[name] == index) for name in worst],
        }
        for index in dict.fromkeys([worst["flip"], *worst.values(), *most])
    ]


def _billboards(cloud: BillboardCloud) -> list[dict[str, Any]]:
    """The textures, sizes and tilt of each billboard."""
    described = []
    for number, textures in enumerate(cloud.textures()):
        half, normal = cloud.half_extents[number].tolist(), cloud.normals[number].double()
        described.append(
            {
                "number": number + 1,
                "color": billboard_color(number),
                "meters": [2 * side for side in half],
                "texels": list(textures.shape[1:3])[::-1],
                "leans": float(normal[1].abs().clamp(max=1).asin().rad2deg()),
                "covers": float(textures[..., 3].ge(_least_seen(cloud)).double().mean()),
                "sides": [_webp(to_bytes(side)) for side in textures],
            }
        )
    return described


def _changed(facts: RunFacts) -> list[tuple[str, Any]]:
    """The options that differ from their defaults, by stage and name."""
    return [
        (f"{stage}.{name}", value)
        for stage, options in facts.options.items()
        for name, value in options.items()
        if value != facts.defaults.get(stage, {}).get(name)
    ]


def _webp(image: NDArray[np.uint8]) -> str:
    return _data("image/webp", encode_webp(image, lossless=False))


def _data(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _count(value: int | None) -> str:
    return "not known" if value is None else f"{value:,}"


def _share(value: float | None) -> str:
    """A share in percent, with two significant digits."""
    return "" if value is None else percent(value, 2)


def _figure(value: Any, digits: int = 3) -> str:
    if value is None:
        return "none"
    if isinstance(value, float):
        return f"{value:.{digits}f}"
    return value if isinstance(value, str) else json.dumps(value, default=str)
