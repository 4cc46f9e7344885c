"""Commands of the studio: data sets, poses, tables, meshes of pictures, figures and pages."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro

from learn3d.commands.command import Command, DataFolder, OnDataset, Runs, Which
from learn3d.data.layouts import Layout, require_categories
from learn3d.files.writing import check_target
from learn3d.pictures import save_png
from learn3d.settings import Count, split_names
from learn3d.studio.make_data.render import DatasetConfig, make_dataset, make_shards
from learn3d.studio.picture_to_mesh.export import export
from learn3d.studio.picture_to_mesh.make import load_model
from learn3d.studio.picture_to_mesh.reconstruction import (
    cut_out_pictures,
    reconstruct_dataset,
    reconstruct_files,
)
from learn3d.studio.poses.comparison import check_true_poses, compare
from learn3d.studio.poses.options import PoseOptions
from learn3d.studio.poses.sheet import draw_pose_sheet
from learn3d.studio.poses.views import MIN_CONFIDENCE, CameraOptions, estimate_views, load_views
from learn3d.studio.tables.experiment import describe_tables, run_experiment
from learn3d.studio.tables.plan import Request
from learn3d.studio.tables.tables import TABLES
from learn3d.terminal import note, say


class MakeDataset(Command):
    """Render a data set from meshes or procedural shapes, in the layout of a published one.

    Examples:
      learn3d make-dataset --output data --category chair --source my_chairs --augment 5
      learn3d make-dataset --output data --category airplane --procedural 300
      learn3d make-dataset --output big --category chair --source my_chairs --shards --jobs 8
    """

    config: DatasetConfig

    def run(self) -> int:
        check_target(self.config.output, "--output", folder=True)
        if self.config.shards:
            return make_shards(self.config)
        say(make_dataset(self.config).text())
        return 0


class EstimatePoses(Command):
    """Estimate the pose of each image of a data set from its mask, for `learn3d train --poses`.

    Examples:
      learn3d estimate-poses photos --layout photos --category mug --elevation 20 --output mug.npz
      learn3d estimate-poses DATA --category airplane --output poses.npz --compare

    It also writes a sheet (poses.png). Look at it: all images below an azimuth must show the
    object from there. Azimuth 0 is a side that the estimate chooses.
    """

    data: DataFolder
    """Folder of the data set."""
    category: str
    """Categories, separated by commas, which share the prototypes."""
    output: Path
    """File of the table (.npz)."""
    layout: Layout = "kato"
    """Arrangement of the files of the data set, see docs/data-sets.md."""
    options: PoseOptions
    cameras: CameraOptions
    compare: bool = False
    """Compare with the known azimuths, and turn the table into their frame, so that voxel IoU can
    be measured."""
    views_per_object: Count | None = None
    """Number of training images of each object. If not given: the layout's protocol, one for kar,
    else all."""

    def run(self) -> None:
        check_target(self.output, "--output")
        if self.output.suffix != ".npz":
            raise ValueError(f"--output must end in .npz, got {self.output}")
        datasets = load_views(self.layout, self.data, self.category, self.views_per_object)
        if self.compare:
            check_true_poses(datasets)
        views = estimate_views(datasets, self.cameras, self.options)
        table, offset_deg = views.table, 0.0
        doubtful = float((table.confidence < MIN_CONFIDENCE).mean())
        mean = table.confidence.mean()
        count = len(table.confidence)
        say(f"{count} images: mean confidence {mean:.2f}, below 0.5: {doubtful:.0%}")
        if self.compare:
            comparison = compare(views)
            say(comparison.text())
            offset_deg = comparison.offset_deg
            table = table.turned(offset_deg)
        for warning in views.warnings:
            note(f"warning: {warning}")
        table.write(self.output)
        sheet = self.output.with_suffix(".png")
        save_png(sheet, draw_pose_sheet(views, offset_deg))
        say(
            f"written to {self.output}; sheet {sheet}: columns: azimuths; first rows: "
            "renderings of the prototypes; other rows: images with that estimated azimuth"
        )


class Experiment(Request, Command):
    """Make a table of the paper: train and measure its runs, and report them beside its values.

    Examples:
      learn3d experiment --list
      learn3d experiment kato --data DATA --output OUT --category airplane,chair --jobs 2
      learn3d experiment ablation --data DATA --output OUT --category chair --set precision=fp32
      learn3d experiment mmd --data DATA --output OUT --category airplane,chair --report-only

    Tables share their runs in OUT/runs/<category>/<method>-seed<k>, with those that `learn3d
    train` made there: complete runs are skipped, interrupted ones continue. Ctrl-C stops all of
    them; the same command continues.
    """

    table: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="TABLE")]]
    list: bool = False
    """Show the tables and their methods, and exit."""

    @classmethod
    def default(cls, arguments: Sequence[str]) -> "Experiment | None":
        return (
            cls(table=next(iter(TABLES)), data=Path(), output=Path())
            if "--list" in arguments
            else None
        )

    def run(self) -> int:
        if self.list:
            say(describe_tables())
            return 0
        if not self.report_only:
            table = TABLES[self.table]
            check_target(self.output, "--output", folder=True)
            categories = split_names(self.category) or table.categories
            require_categories(self.layout or table.layout, self.data, categories)
        return run_experiment(self)


class Reconstruct(OnDataset):
    """Turn images into meshes, each with a turntable animation and a strip of views.

    Examples:
      learn3d reconstruct photo.png --output meshes    (transparent background; the package's model)
      learn3d reconstruct photo.jpg --masks mask.png --run runs/airplane --output meshes
      learn3d reconstruct --data DATA --indices 0 31 62 --run runs/airplane --output meshes
    """

    output: Path
    """Folder for the results: a mesh, a turntable GIF and a PNG strip of each image."""
    category: str | None = None
    """Category of the object in the image files (default: recognized), or of the data set (default:
    the run's)."""
    guesses: Count = 1
    """Largest number of different shapes for each image file, the best first; a model without
    templates makes one."""
    smooth: bool = False
    """Inflate the outline of each image file to a smooth shape instead, for objects of other
    kinds."""
    model: Annotated[Path | None, tyro.conf.arg(name="run")] = None
    """Run folder (or checkpoint file) of the trained model. If not given: the small model of the
    package."""
    images: tyro.conf.Positional[
        Annotated[tuple[Path, ...], tyro.conf.arg(metavar="[IMAGE ...]")]
    ] = ()
    """Images of any size. If not given: images of --data. In those without transparency, --masks or
    --box the object is searched: it is what differs from a plain background, or else a small
    network finds it (needs the extra photos)."""
    masks: tuple[Path, ...] = ()
    """Mask images (white = object), one for each image. If not given: the transparency of the
    images."""
    box: tuple[int, int, int, int] | None = None
    """Box around the object in a single photograph: X Y WIDTH HEIGHT in pixels, from the upper
    left. The object is cut out of it (needs the extra photos)."""
    crop: bool = True
    """Centre and scale the object in each image as in the data set. --no-crop: images are framed
    like that already."""
    data: Path | None = None
    """Data set from which images are taken. If not given: image files are given."""
    indices: tuple[int, ...] = (0,)
    """Images of the data set: object * V + view, if each object has V views (Kato's: 24, Kar's:
    20)."""
    refine: bool | None = None
    """Fit the predicted shapes to the masks. The cameras are those of the data set; for image files
    cameras and colours are estimated. If not given: yes for image files, no for --data."""
    format: Literal["glb", "obj", "ply"] = "glb"
    """Format of the mesh files: one welded mesh with smooth normals and colours at the vertices."""

    def run(self) -> None:
        if bool(self.images) == (self.data is not None):
            raise ValueError("give either image files, or --data with --indices")
        if self.box is not None and (len(self.images) > 1 or self.masks):
            raise ValueError("--box is for one photograph, without --masks")
        if self.smooth:
            self.refuse("--smooth", "category", "guesses", "refine")
        if self.model is None and self.which != "last":
            raise ValueError("--checkpoint chooses one of a run's checkpoints; give --run, too")
        own = ("masks", "box", "crop", "guesses", "smooth")  # options for image files
        self.refuse(*(("--data", *own) if self.data else ("image files", "split", "indices")))
        check_target(self.output, "--output", folder=True)
        if self.data is not None:
            options = self.pick("indices") | {"refined": bool(self.refine)}
            paths = reconstruct_dataset(self.model, self.output, mesh_format=self.format, **options)
        else:
            names = ("images", "which", "category", "masks", "crop", "box", "guesses", "smooth")
            options = {name: getattr(self, name) for name in names}
            options["refined"] = self.refine is not False
            paths = reconstruct_files(self.model, self.output, mesh_format=self.format, **options)
        for path in paths:
            say(str(path))


class Export(Command):
    """Write the networks of a run into one small file, in half precision, for use alone.

    Example:
      learn3d export --run runs/chair --output chair.safetensors
    """

    source: Annotated[Path, tyro.conf.arg(name="run")]
    """Run folder (or checkpoint file) of the trained model."""
    output: Path
    """File to write, .safetensors."""
    which: Which = "last"
    """Checkpoint of a run: the last one, or the one with the best validation IoU."""
    others: Path | None = None
    """Folder of PNG files with transparency that show other things, so that `reconstruct` warns of
    such pictures. If not given: it warns of pictures that are far from all training images."""

    def run(self) -> None:
        check_target(self.output, "--output")
        others = (
            None
            if self.others is None
            else cut_out_pictures(load_model(self.source, self.which), self.others)
        )
        size = export(self.source, self.output, which=self.which, others=others)
        say(f"{self.output} ({size / 1e6:.1f} MB)")


class Figures(OnDataset):
    """Draw the paper's figures from trained runs.

    Figures:
      grid           test images and each run's shape from the input's view and five more (PNG)
      tsne           shape codes of test images in the plane, coloured by the view (PNG, SVG)
      interpolation  shapes between those of some test images (PNG)

    Examples:
      learn3d figures grid --runs runs/vanilla runs/proposed --output pictures/comparison.png
      learn3d figures tsne --runs runs/vanilla runs/proposed --output pictures/tsne.png
    """

    figure: tyro.conf.Positional[
        Annotated[Literal["grid", "tsne", "interpolation"], tyro.conf.arg(metavar="FIGURE")]
    ]
    """One of the figures above."""
    runs: tuple[Path, ...]
    """Run folders (or checkpoint files), in the order of the figure."""
    output: Path
    """File to write; its ending is replaced by those of the figure's formats."""
    labels: tuple[str, ...] = ()
    """Names of the runs. If not given: those of their presets."""
    images: Count | None = None
    """Number of images. If not given: 6 in a grid, 3 in an interpolation."""
    indices: tuple[int, ...] = ()
    """Samples of the data set in a grid or an interpolation. If not given: --images of different
    objects and views."""
    truth: bool = False
    """Show the ground-truth voxels in a grid as well."""

    def run(self) -> None:
        from learn3d.studio.tables import grids, tsne
        from learn3d.studio.tables.trained_models import open_runs

        check_target(self.output.parent, "--output", folder=True)
        refused = {"grid": (), "interpolation": ("truth",), "tsne": ("images", "indices", "truth")}[
            self.figure
        ]
        self.refuse(f"the figure {self.figure}", *refused)
        runs = open_runs(self.runs, **self.pick("labels"))
        without = [run.dataset.category for run in runs if run.dataset.poses is None]
        if without and self.figure != "tsne":
            raise ValueError(
                f"the figure {self.figure} needs camera poses, which the data of {without[0]} do not have"
            )
        save = {
            "grid": grids.save_grid,
            "interpolation": grids.save_interpolation,
            "tsne": tsne.save_tsne,
        }[self.figure]
        paths = save(runs, self.output, **self.given("images", "indices", "truth"))
        say("\n".join(map(str, paths)))


class Report(OnDataset):
    """Write one HTML file about trained runs: options, curves, test IoU, and shapes to turn.

    Examples:
      learn3d report runs/plus runs/vanilla --output report.html
      learn3d report runs/plus --data DATA --objects 30 --output report.html
    """

    runs: Runs
    """Run folders, or checkpoint files, of one category."""
    output: Path
    """File to write, .html."""
    labels: tuple[str, ...] = ()
    """Names of the runs. If not given: those of their presets."""
    objects: Count = 12
    """Number of objects to show, spread from the best IoU to the worst."""

    def run(self) -> None:
        from learn3d.studio.tables.report import write_report

        check_target(self.output, "--output")
        size = write_report(self.runs, self.output, **self.pick("labels", "objects"))
        say(f"{self.output} ({size / 1e6:.1f} MB)")


class Demo(Command):
    """Open a page in the browser that turns pictures into meshes.

    Examples:
      learn3d demo
      learn3d demo --run runs/vanilla runs/proposed    (meshes of both, side by side)
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.arg(name="run")] = ()
    """Run folders (or checkpoint files) of trained models. If not given: the small model of the
    package."""
    port: int = 7860
    """Port of the page's address, http://HOST:PORT."""
    host: str = "127.0.0.1"
    """Address to listen on. With 0.0.0.0 everybody in the network can use the page."""
    browser: bool = True
    """Open a browser. --no-browser: only print the address of the page."""

    def run(self) -> None:
        from learn3d.studio.demo.server import serve

        serve(self.runs, host=self.host, port=self.port, browser=self.browser)
