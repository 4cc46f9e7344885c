"""A run: its state, saved and restored bit-identically, and its summary."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from learn3d import distributed
from learn3d.config import TrainConfig, check_resume, config_to_dict
from learn3d.data.dataset import DatasetInfo, ViewDataset
from learn3d.data.poses import PoseCandidates
from learn3d.device import ThreadTuner
from learn3d.files import writing
from learn3d.files.reading import DamagedFile
from learn3d.methods.mesh_method import is_compact
from learn3d.methods.method import Method
from learn3d.presets import load_config
from learn3d.runs import checkpoint
from learn3d.runs import folder as run_folder
from learn3d.runs.checkpoint import Metadata, Progress, versions
from learn3d.runs.folder import BEST, CONFIG, LAST, PREVIOUS
from learn3d.runs.log import RunLog


@dataclass(frozen=True)
class Summary:
    """The result of a call of `train`."""

    folder: Path
    progress: Progress
    finished: bool  # False if a signal stopped it
    seconds: float  # duration of this call

    def __str__(self) -> str:
        """One line for the terminal."""
        done = self.progress
        minutes = self.progress.seconds / 60
        end = f"{'finished' if self.finished else 'stopped'} at step {done.step} after {self.seconds / 60:.1f} min"
        if done.seconds > self.seconds + 1:
            end += f" ({minutes:.1f} min of training in all)"
        best = (
            f"best validation IoU {done.best_iou:.4f} at step {done.best_step}; "
            if done.best_step
            else ""
        )
        return f"{end}; {best}everything is in {self.folder}"


def describe_images(dataset: ViewDataset) -> str:
    """Number of the images of a data set, and a checksum over images, masks, poses and classes."""
    return f"{len(dataset)} images with the CRC-32 {dataset.digest(voxels=False):08x}"


@dataclass(frozen=True, eq=False)
class Run:
    """Everything in a checkpoint besides the progress."""

    config: TrainConfig  # with a resolved precision, bf16 or fp32
    method: Method
    info: DatasetInfo
    data: str  # `describe_images` of the training images
    # estimated poses of the training images, whose weights change
    candidates: PoseCandidates | None = None
    versions: dict[str, str | None] = field(default_factory=versions)

    def begin(
        self, train_set: ViewDataset, *, resume: bool, overwrite: bool
    ) -> tuple[Progress, tuple[str, ...]]:
        """Prepare method and folder for a new run, or restore the last checkpoint.

        Returns the progress of the run, and warnings. The folder of a finished run does not change.
        """
        config = self.config
        folder = self.config.output
        saved, notes = load_last(config) if resume else (None, ())
        if saved is not None:
            progress = self._restore(*saved)
        else:
            progress = Progress(object_share=train_set.mean_object_size())
            self.method.start_from_pretrained()
        if progress.step > config.iterations:
            raise ValueError(
                f"{folder} has taken {progress.step} steps, more than the {config.iterations} asked for"
            )
        if distributed.rank() > 0:
            return progress, notes
        if resume:
            run_folder.remove_partials(folder)
        if progress.step < config.iterations:
            if not resume:
                run_folder.remove_old_run(folder, overwrite)
            writing.write_json(folder / CONFIG, config_to_dict(config), sync=True)
        return progress, notes

    def describe(
        self, progress: Progress, train_set: ViewDataset, val_set: ViewDataset, threads: ThreadTuner
    ) -> str:
        """Method, data and device of a run; mirror plane and generator if masks decide."""
        config = self.config
        info = self.info
        verb = f"resuming at step {progress.step}" if progress.step else "training"
        name = f"{config.label} ({config.preset})"
        data = f"{len(train_set)} images of {train_set.num_objects} objects; {config.val_split}: {len(val_set)} images"
        where = f"{config.device}, {config.precision}, {threads}{distributed.describe()}"
        text = f"{verb}: {name} on {config.category}, {data}; {where}; output {config.output}"
        if config.settings.wants_mirror_plane and info.mirror_plane_deg is None:
            text += "\nno mirror plane found in the masks (about 150 are needed); set it with --symmetry"
        elif config.settings.wants_mirror_plane:
            azimuth = f"{info.mirror_plane_deg:g}"
            text += f"\nmirror plane: along the viewing direction of azimuth {azimuth}, found from the masks"
        if config.settings.wants_solidity:
            kind = "compact" if is_compact(info) else "not compact"
            text += f"\nobjects: {kind}, as masks fill {info.solidity:.2f} of their convex hulls"
        return text

    def _restore(self, tensors: dict[str, Tensor], metadata: Metadata) -> Progress:
        """Restore the state of a checkpoint.

        Raises a ValueError that names options or data that differ.
        """
        config = self.config
        before = metadata.config
        path = self.config.output / LAST
        check_resume(config, before)
        if self.data != metadata.data:
            raise ValueError(
                f"cannot resume with other training data: {metadata.data} in the run, {self.data} in {config.data}; "
                "give the run's own data set, or start a new run"
            )
        if self.info != metadata.info:
            raise ValueError(
                f"{path} was trained on data of {metadata.info}, these are {self.info}"
            )
        checkpoint.restore_networks(self.method, tensors, path)
        if self.method.ema is not None:
            with self.method.ema_weights():
                checkpoint.restore_networks(self.method, tensors, path, "ema")
        for name, optimizer in self.method.optimizers.items():
            checkpoint.restore_optimizer(name, optimizer, tensors, path)
        if self.candidates is not None:
            self.candidates.reweight(tensors["poses.weights"].numpy())
        if "random.cpu" not in tensors:
            raise ValueError(
                f"{path} holds no state of the random numbers; is it the last checkpoint of a run?"
            )
        torch.set_rng_state(tensors["random.cpu"])
        if config.device == "cuda" and "random.cuda" in tensors:
            torch.cuda.set_rng_state(tensors["random.cuda"])
        if (before.val_split, before.max_val_images) != (config.val_split, config.max_val_images):
            # measured on other images
            return dataclasses.replace(metadata.progress, best_iou=-1.0, best_step=0)
        return metadata.progress

    def save(self, progress: Progress, log: RunLog) -> None:
        """Flush the metrics, then write last.safetensors with all that a resumption needs.

        The checkpoint before it becomes previous.safetensors. Neither file is ever incomplete.
        """
        if distributed.rank() > 0:
            distributed.wait_for_writer()
            return
        log.sync()
        method = self.method
        last = self.config.output / LAST
        tensors = checkpoint.network_tensors(method) | {"random.cpu": torch.get_rng_state()}
        if method.ema is not None:
            tensors |= {f"ema.{name}": tensor for name, tensor in method.ema.tensors.items()}
        if self.candidates is not None:
            tensors["poses.weights"] = torch.from_numpy(self.candidates.weights)
        if self.config.device == "cuda":
            tensors["random.cuda"] = torch.cuda.get_rng_state()
        for name, optimizer in method.optimizers.items():
            tensors |= checkpoint.optimizer_tensors(name, optimizer)
        if last.is_file():
            writing.give_second_name(last, last.with_name(PREVIOUS))
        self._write(last, tensors, progress)
        distributed.wait_for_writer()

    def save_best(self, progress: Progress) -> None:
        """Write best.safetensors: the networks, with EMA weights if the run has them."""
        if distributed.rank() > 0:
            return
        with self.method.ema_weights():
            self._write(
                self.config.output / BEST, checkpoint.network_tensors(self.method), progress
            )

    def _write(self, path: Path, tensors: dict[str, Tensor], progress: Progress) -> None:
        checkpoint.save(
            path, tensors, Metadata(self.config, self.info, progress, self.data, self.versions)
        )


def load_last(
    config: TrainConfig,
) -> tuple[tuple[dict[str, Tensor], Metadata] | None, tuple[str, ...]]:
    """The newest undamaged checkpoint of a run, or None if it has none yet; and warnings.

    If last.safetensors is damaged or missing, previous.safetensors replaces it. Raises ValueError
    if the folder has no run or one with other options; DamagedFile if all checkpoints are
    damaged; OSError if one cannot be read.
    """
    folder = config.output
    notes = []
    paths = run_folder.checkpoints(folder)
    if not paths:
        if not run_folder.is_run(folder):
            raise ValueError(
                f"there is no checkpoint and no {CONFIG} in {folder}; start the run without --resume"
            )
        check_resume(config, load_config(folder / CONFIG))
    for path in paths:
        try:
            saved = checkpoint.load(path)
        except DamagedFile as error:
            notes.append(str(error))
            continue
        if path.name == PREVIOUS and distributed.rank() == 0:
            writing.give_second_name(path, folder / LAST)
            notes.append(
                "going on from the checkpoint before it; the steps since then are repeated"
            )
        return saved, tuple(notes)
    if notes:
        raise DamagedFile(
            folder, "; ".join(notes) + "; no checkpoint is whole: start a new run (--overwrite)"
        )
    return None, ()
