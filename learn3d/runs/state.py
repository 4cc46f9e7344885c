"""The state of a run: saved, and restored bit-identically."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import torch
from torch import Tensor

from learn3d.config import TrainConfig, check_resume, config_to_dict, load_config
from learn3d.data.dataset import ViewDataset
from learn3d.data.poses import PoseCandidates
from learn3d.files import writing
from learn3d.methods import DatasetInfo, Method
from learn3d.runs import checkpoint
from learn3d.runs import folder as run_folder
from learn3d.runs.checkpoint import Metadata, Progress, versions
from learn3d.runs.folder import BEST, CONFIG, LAST, PREVIOUS
from learn3d.runs.log import RunLog


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
    candidates: PoseCandidates | None = None  # estimated poses of the training images, whose weights change
    versions: dict[str, str | None] = field(default_factory=versions)

    def begin(self, train_set: ViewDataset, *, resume: bool, overwrite: bool) -> tuple[Progress, tuple[str, ...]]:
        """Prepare method and folder for a new run, or restore the last checkpoint.

        Returns the progress of the run, and warnings. The folder of a finished run does not change.
        """
        config, folder = self.config, self.config.output
        saved, notes = load_last(config) if resume else (None, ())
        if saved is not None:
            progress = self._restore(*saved)
        else:
            progress = Progress(object_share=train_set.mean_object_size())
            self.method.start_from_pretrained()
        if progress.step > config.iterations:
            raise ValueError(f"{folder} has taken {progress.step} steps, more than the {config.iterations} asked for")
        if resume:
            run_folder.remove_partials(folder)
        if progress.step == config.iterations:
            return progress, notes
        if not resume:
            run_folder.remove_old_run(folder, overwrite)
        writing.write_json(folder / CONFIG, config_to_dict(config), sync=True)
        return progress, notes

    def _restore(self, tensors: dict[str, Tensor], metadata: Metadata) -> Progress:
        """Restore the state of a checkpoint. Raises a ValueError that names options or data that differ."""
        config, before, path = self.config, metadata.config, self.config.output / LAST
        check_resume(config, before)
        if self.data != metadata.data:
            raise ValueError(
                f"cannot resume with other training data: {metadata.data} in the run, {self.data} in {config.data}; "
                "give the run's own data set, or start a new run"
            )
        if self.info != metadata.info:
            raise ValueError(f"{path} was trained on data of {metadata.info}, these are {self.info}")
        checkpoint.restore_networks(self.method, tensors, path)
        if self.method.ema is not None:
            with self.method.ema_weights():
                checkpoint.restore_networks(self.method, tensors, path, "ema")
        for name, optimizer in self.method.optimizers.items():
            checkpoint.restore_optimizer(name, optimizer, tensors, path)
        if self.candidates is not None:
            self.candidates.weights[:] = tensors["poses.weights"]
        if "random.cpu" not in tensors:
            raise ValueError(f"{path} holds no state of the random numbers; is it the last checkpoint of a run?")
        torch.set_rng_state(tensors["random.cpu"])
        if config.device == "cuda" and "random.cuda" in tensors:
            torch.cuda.set_rng_state(tensors["random.cuda"])
        if (before.val_split, before.max_val_images) != (config.val_split, config.max_val_images):
            return dataclasses.replace(metadata.progress, best_iou=-1.0, best_step=0)  # measured on other images
        return metadata.progress

    def save(self, progress: Progress, log: RunLog) -> None:
        """Flush the metrics, then write last.safetensors: networks, EMA, optimizers, random state and `Metadata`.

        The checkpoint before it becomes previous.safetensors. Neither file is ever incomplete.
        """
        log.sync()
        folder = self.config.output
        tensors = checkpoint.network_tensors(self.method)
        if self.method.ema is not None:
            tensors |= {f"ema.{name}": tensor for name, tensor in self.method.ema.tensors.items()}
        if self.candidates is not None:
            tensors["poses.weights"] = torch.from_numpy(self.candidates.weights)
        tensors["random.cpu"] = torch.get_rng_state()
        if self.config.device == "cuda":
            tensors["random.cuda"] = torch.cuda.get_rng_state()
        for name, optimizer in self.method.optimizers.items():
            tensors |= checkpoint.optimizer_tensors(name, optimizer)
        if (folder / LAST).is_file():
            writing.give_second_name(folder / LAST, folder / PREVIOUS)
        checkpoint.save(folder / LAST, tensors, self._metadata(progress))

    def save_best(self, progress: Progress) -> None:
        """Write best.safetensors: the networks, with EMA weights if the run has them."""
        with self.method.ema_weights():
            networks = checkpoint.network_tensors(self.method)
            checkpoint.save(self.config.output / BEST, networks, self._metadata(progress))

    def _metadata(self, progress: Progress) -> Metadata:
        return Metadata(self.config, self.info, progress, self.data, self.versions)


def load_last(config: TrainConfig) -> tuple[tuple[dict[str, Tensor], Metadata] | None, tuple[str, ...]]:
    """The newest undamaged checkpoint of a run, or None if it has none yet; and warnings.

    If last.safetensors is damaged or missing, previous.safetensors replaces it. Raises ValueError if the folder has no
    run or one with other options; DamagedError if all checkpoints are damaged; OSError if one cannot be read.
    """
    folder, notes = config.output, []
    paths = run_folder.checkpoints(folder)
    if not paths:
        if not run_folder.is_run(folder):
            raise ValueError(f"there is no checkpoint and no {CONFIG} in {folder}; start the run without --resume")
        check_resume(config, load_config(folder / CONFIG))
    for path in paths:
        try:
            saved = checkpoint.load(path)
        except checkpoint.DamagedError as error:
            notes.append(str(error))
            continue
        if path.name == PREVIOUS:
            writing.give_second_name(path, folder / LAST)
            notes.append("going on from the checkpoint before it; the steps since then are repeated")
        return saved, tuple(notes)
    if notes:
        raise checkpoint.DamagedError("; ".join(notes) + "; no checkpoint is whole: start a new run (--overwrite)")
    return None, ()
