"""A run that goes on: what is saved so that it continues bit for bit, and what it must find again as it was."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from learn3d.config import TrainConfig, check_resume, config_to_dict, load_config
from learn3d.data.dataset import ViewDataset
from learn3d.distributed.process_group import ProcessGroup, weights_checksum
from learn3d.files import writing
from learn3d.methods import DatasetInfo, Method
from learn3d.runs import checkpoint
from learn3d.runs import folder as run_folder
from learn3d.runs.checkpoint import DataFingerprint, Metadata, Progress
from learn3d.runs.folder import BEST, CONFIG, LAST
from learn3d.runs.log import RunLog, SilentLog
from learn3d.runs.versions import versions


def fingerprint_of(train_set: ViewDataset, precision: str) -> DataFingerprint:
    """The fingerprint of a run on these training images."""
    return DataFingerprint(len(train_set), f"{train_set.digest(voxels=False):08x}", precision)


@dataclass(frozen=True, eq=False)
class Saved:
    """A checkpoint that a run goes on from."""

    path: Path
    tensors: dict[str, Tensor]
    metadata: Metadata
    notes: tuple[str, ...] = ()  # what was wrong with newer ones


@dataclass(frozen=True, eq=False)
class Run:
    """What a checkpoint is made of, besides the progress."""

    config: TrainConfig
    method: Method
    info: DatasetInfo
    fingerprint: DataFingerprint
    group: ProcessGroup
    versions: dict[str, str | None] = field(default_factory=versions)  # of the code that runs

    def begin(
        self, train_set: ViewDataset, val_set: ViewDataset, *, resume: bool, overwrite: bool
    ) -> tuple[Progress, tuple[str, ...]]:
        """Bring networks, optimizers and random numbers to where the run stands: its start, or its last checkpoint.

        Then take the folder, where nothing is left that could be wrong, and let all processes learn together. Returns
        where the run stands, and what to warn of. A finished run stays as it is.
        """
        config, folder = self.config, self.config.output
        progress, notes = Progress(object_share=train_set.object_share()), ()
        saved = None
        if resume:
            with self.group.main_process_first():  # it may have to put an earlier checkpoint in place
                saved = load_last(config, repair=self.group.is_main)
        if saved is not None:
            progress, notes = self._restore(saved), saved.notes
        else:
            self.method.start_from_pretrained()
        if progress.step > config.iterations:
            raise ValueError(f"{folder} has taken {progress.step} steps, more than the {config.iterations} asked for")
        if self.group.is_main and resume:
            run_folder.remove_partials(folder)
        if progress.step == config.iterations:
            if self.group.is_main:
                run_folder.remove_old(folder, progress.step, config.keep_checkpoints)
            return progress, notes
        self.method.distribute(self.group)
        self._compare_processes(progress, train_set, val_set)
        if self.group.is_main:
            if not resume:
                run_folder.remove_old_run(folder, overwrite)
            writing.write_json(folder / CONFIG, config_to_dict(config), sync=True)
        return progress, notes

    def _compare_processes(self, progress: Progress, train_set: ViewDataset, val_set: ViewDataset) -> None:
        """Raise a ValueError naming what is not the same in all processes of the run."""
        if self.group.world_size == 1:
            return
        options = dataclasses.replace(self.config, data=Path("-"), output=Path("-"), threads=None)
        same = {
            "options": config_to_dict(options),
            "precision": self.fingerprint.precision,
            "what the networks depend on": self.info,
            "training data": (self.fingerprint, train_set.digest()),
            "validation data": (len(val_set), val_set.digest()),
            "steps taken": progress.step,
            "weights": weights_checksum(self.method.networks),
        }
        self.group.check_equal(**same)

    def _restore(self, saved: Saved) -> Progress:
        """Bring everything back to the state that `save_last` wrote.

        An option or a condition that differs is a ValueError that names it.
        """
        tensors, metadata, precision = saved.tensors, saved.metadata, saved.metadata.fingerprint.precision
        if precision == self.fingerprint.precision:  # asked for by name or by "auto", it is the same
            precision = self.config.precision
        elif self.config.precision == "auto":
            precision = metadata.config.precision
        check_resume(self.config, dataclasses.replace(metadata.config, precision=precision))
        _check_fingerprint(self.fingerprint, metadata.fingerprint, self.config.data)
        if self.info != metadata.info:
            raise ValueError(f"{saved.path} was trained on data of {metadata.info}, these are {self.info}")
        checkpoint.restore_networks(self.method, tensors, saved.path)
        if self.method.ema is not None:
            with self.method.ema_weights():
                checkpoint.restore_networks(self.method, tensors, saved.path, "ema")
        for name, optimizer in self.method.optimizers.items():
            others = metadata.optimizers.get(name, {})
            checkpoint.restore_optimizer(name, optimizer, tensors, others, saved.path)
        try:
            torch.set_rng_state(tensors["random.cpu"])
            if self.config.device == "cuda" and "random.cuda" in tensors:
                torch.cuda.set_rng_state(tensors["random.cuda"])
        except (KeyError, RuntimeError, TypeError) as error:
            raise ValueError(
                f"{saved.path} holds no state of the random numbers that this torch can use ({error}); is it the last "
                "checkpoint of a run?"
            ) from None
        before = metadata.config
        if (before.val_split, before.max_val_images) != (self.config.val_split, self.config.max_val_images):
            return dataclasses.replace(metadata.progress, best_iou=-1.0, best_step=0)  # of other images
        return metadata.progress

    def save(self, progress: Progress, log: RunLog | SilentLog) -> None:
        """Write last.safetensors by the first process, where all have the same weights, and what was logged before."""
        self.group.check_equal(weights=0 if self.group.world_size == 1 else weights_checksum(self.method.networks))
        if self.group.is_main:
            log.sync()
            self.save_last(progress)

    def save_last(self, progress: Progress) -> None:
        """Write last.safetensors: networks, optimizers, random state, and all of `Metadata`.

        A complete file has that name at every moment; the ones before it are kept as `config.keep_checkpoints` says.
        Raises FloatingPointError, with nothing written, for values that are not finite, as they could not be resumed.
        """
        folder, keep, others = self.config.output, self.config.keep_checkpoints, {}
        self._check_networks()
        tensors = checkpoint.network_tensors(self.method)
        if self.method.ema is not None:
            tensors |= {f"ema.{name}": tensor for name, tensor in self.method.ema.tensors.items()}
        tensors["random.cpu"] = torch.get_rng_state()
        if self.config.device == "cuda":
            tensors["random.cuda"] = torch.cuda.get_rng_state()
        for name, optimizer in self.method.optimizers.items():
            state, others[name] = checkpoint.optimizer_state(name, optimizer)
            checkpoint.check_finite(f"optimizer of the {name}", state)
            tensors |= state
        if keep > 1:
            run_folder.keep_previous(folder)
        checkpoint.save(folder / LAST, tensors, self._metadata(progress, others))
        run_folder.remove_old(folder, progress.step, keep)

    def save_best(self, progress: Progress) -> None:
        """Write best.safetensors by the first process: the networks, or their averages, for use."""
        with self.method.ema_weights():
            self._check_networks()
            if self.group.is_main:
                networks = checkpoint.network_tensors(self.method)
                checkpoint.save(self.config.output / BEST, networks, self._metadata(progress, {}))

    def _check_networks(self) -> None:
        """Refuse to save networks that are no longer finite: the checkpoint on disk is better than they are."""
        for name, network in self.method.networks.items():
            checkpoint.check_finite(name, network.state_dict())

    def _metadata(self, progress: Progress, optimizers: dict) -> Metadata:
        return Metadata(self.config, self.info, progress, self.fingerprint, self.versions, optimizers)


def load_last(config: TrainConfig, *, repair: bool = True) -> Saved | None:
    """The newest checkpoint of a run that is whole, or None where the run was stopped before its first.

    A damaged last.safetensors is put aside and the one before it takes its place; `notes` say so. Without `repair`
    nothing is renamed, and a damaged one is an error: of several processes only the first one repairs, before the
    others look. Raises ValueError where there is no run, or one without a checkpoint that began with other options than
    `config`, DamagedError where there are checkpoints, but none of them is whole, and OSError where one cannot be
    reached.
    """
    folder = config.output
    candidates = run_folder.checkpoints(folder)
    if not candidates and not (folder / CONFIG).is_file():
        raise ValueError(f"there is no checkpoint and no {CONFIG} in {folder}; start the run without --resume")
    notes: list[str] = []
    for path in candidates:
        try:
            tensors, metadata = checkpoint.load(path)
        except checkpoint.DamagedError as error:
            if not repair:
                raise
            notes.append(str(error))
            continue
        if path.name != LAST and repair:
            run_folder.put_in_place(path)
            notes.append(f"going on from the checkpoint before it, {path}; the steps since then are repeated")
        return Saved(path, tensors, metadata, tuple(notes))
    best = _reached_by(folder / BEST)
    if candidates:
        left = f"; {BEST} can still be evaluated" if best else ""
        raise checkpoint.DamagedError(
            "; ".join(notes) + f"; no checkpoint is whole: start a new run (--overwrite){left}"
        )
    began = load_config(folder / CONFIG)
    check_resume(config, began)
    if best > began.checkpoint_every:
        raise ValueError(
            f"the run in {folder} came to step {best} at least ({BEST}), but its checkpoints are missing: put {LAST} "
            f"or one of {run_folder.EARLIER}/ back, or replace the run (--overwrite)"
        )
    return None


def _reached_by(path: Path) -> int:
    """The step of a checkpoint; 0 where there is none that can be read."""
    try:
        return checkpoint.load_metadata(path).progress.step
    except ValueError:
        return 0


def _check_fingerprint(now: DataFingerprint, then: DataFingerprint, data: Path) -> None:
    """Raise a ValueError naming what differs from the fingerprint that a checkpoint recorded."""
    if then.precision != now.precision:
        raise ValueError(
            f"cannot resume: the run computes in {then.precision}, but precision 'auto' means {now.precision} here; "
            f"ask for precision {then.precision}"
        )
    if then.samples != now.samples or then.images != now.images:
        raise ValueError(
            f"cannot resume with other training data: {then.samples} images with the CRC-32 {then.images} in the run, "
            f"{now.samples} with {now.images} in {data}; give the run's own data set, or start a new run"
        )
