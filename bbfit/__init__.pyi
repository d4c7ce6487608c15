"""The public names of bbfit and where they come from; __init__.py reads this file to import a name when it is first used."""

from .blender.config import ViewsConfig as ViewsConfig
from .blender.views_folder import render_views as render_views
from .budget.choice import choose as choose
from .budget.config import BudgetConfig as BudgetConfig
from .checks import InputError as InputError
from .comparison.config import CompareConfig as CompareConfig
from .comparison.many_trees import compare_trees as compare_trees
from .comparison.one_tree import compare as compare
from .evaluation.report import Report as Report
from .evaluation.scoring import evaluate as evaluate
from .exporting.config import ExportConfig as ExportConfig
from .exporting.config import LodConfig as LodConfig
from .exporting.model import export as export
from .fitting.config import FitConfig as FitConfig
from .fitting.loop import FitResult as FitResult
from .fitting.loop import fit as fit
from .forest.building import Forest as Forest
from .forest.building import build_forest as build_forest
from .forest.building import read_forest as read_forest
from .forest.config import ForestConfig as ForestConfig
from .forest.config import RegisterConfig as RegisterConfig
from .forest.config import ScatterConfig as ScatterConfig
from .frames.config import FramesConfig as FramesConfig
from .frames.measurement import measure_frames as measure_frames
from .geometry.camera import Camera as Camera
from .geometry.cloud import BillboardCloud as BillboardCloud
from .geometry.orbit import Orbit as Orbit
from .inputs import InputLimits as InputLimits
from .lod import build_lod as build_lod
from .pipeline import RunConfig as RunConfig
from .pipeline import run as run
from .rendering.dispatch import render as render
from .sweep.config import SweepConfig as SweepConfig
from .sweep.scheduling import run_sweep as run_sweep
from .tree_files.tree_file import TreeFile as TreeFile
from .trees.config import GrowConfig as GrowConfig
from .trees.growth import grow as grow
from .trees.species import Species as Species
from .trees.species import load_species as load_species
from .trees.tree_writer import write_tree as write_tree
from .viewing.server import view as view
from .views.dataset import ViewDataset as ViewDataset

__version__: str
