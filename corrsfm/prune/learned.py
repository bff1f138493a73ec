"""Prune methods by networks: numpy in, numpy out around one; owns device, batches and memory."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from corrsfm.config import MatchInput, OperatingPoint, Precision, PruneConfig, to_dict
from corrsfm.errors import CheckpointError, CorrsfmError, InputError
from corrsfm.machine import count_threads, find_device, keep_freed_memory
from corrsfm.model import CorrAdaptor, Rival, RivalOutput, load_network, weights
from corrsfm.prune.correspondences import SIDE_LAYOUTS, missing_channels, side_information
from corrsfm.prune.robust import normalised_residuals
from corrsfm.prune.selection import readable_matches, score_matches, select_candidates, select_kept
from corrsfm.types import Correspondences, PruneResult, TwoViewModel

__all__ = ["Pruner", "choose_precision", "pack_batches"]

logger = logging.getLogger(__name__)

# Fewer matches than this after two prunings give the eight-point algorithm an arbitrary matrix.
_MIN_NUM_FOR_MATRIX = 8

MIN_BFLOAT16_CHANNELS = 64

# Below these counts a pair says too little for the guard to judge it.
_GUARD_MIN_MATCHES = 50
_GUARD_RATIO = 0.8
_GUARD_MIN_SHARE = 0.1


class NetworkEstimate(NamedTuple):
    """Output of the network for one pair."""

    logits: NDArray[np.float32]
    """(M,) last logit of every match, −inf for those that the network did not see."""
    essential: NDArray[np.float64] | None
    """(3, 3) acts on normalised coordinates; None if too few matches were left to determine it."""


def choose_precision(precision: Precision, device: torch.device, channels: int) -> torch.dtype:
    """Number format to compute in.

    ``auto`` is bfloat16 where the processor multiplies it natively and the network is wide enough for that to
    pay: with 32 channels the conversions cost more than the products save.
    """
    if precision is not Precision.AUTO:
        return torch.bfloat16 if precision is Precision.BFLOAT16 else torch.float32
    if channels < MIN_BFLOAT16_CHANNELS:
        return torch.float32
    if device.type == "cuda":
        native = torch.cuda.get_device_capability(device)[0] >= 8
    else:
        # Older releases lack some of these queries; without them use float32.
        native = any(
            getattr(torch.cpu, question, bool)()
            for question in ("_is_avx512_bf16_supported", "_is_amx_tile_supported")
        )
    return torch.bfloat16 if native else torch.float32


def pack_batches(sizes: Sequence[int], max_batch_matches: int) -> list[list[int]]:
    """Group pairs so that little of a batch is padding and none is too large.

    Parameters
    ----------
    sizes : sequence of int
        Matches of each pair.
    max_batch_matches : int
        Bound of pairs × largest size in a batch; a pair that exceeds it alone is a batch of its own.

    Returns
    -------
    list of list of int
        Positions in ``sizes``, largest first; each occurs once.
    """
    batches: list[list[int]] = []
    # Largest first, so that running out of memory happens at the start, not after hours.
    for index in sorted(range(len(sizes)), key=lambda position: -sizes[position]):
        if batches and (len(batches[-1]) + 1) * sizes[batches[-1][0]] <= max_batch_matches:
            batches[-1].append(index)
        else:
            batches.append([index])
    return batches


class Pruner:
    """Prunes pairs of any sizes with a network.

    Parameters
    ----------
    network : CorrAdaptor or Rival
        Is moved to the device and put into evaluation mode. Its ``usage`` says which matches it reads and
        which scores keep one.
    checkpoint_sha256 : str
        Where the network's weights come from, for `fingerprint`.
    device : str
        auto, cpu, cuda or cuda:N.
    operating_point : OperatingPoint
        See `corrsfm.prune.selection.select_kept`.
    max_candidates : int
        Matches of a pair that the network sees, of those it reads, smallest ratio first. Its essential matrix
        is verified on all putative matches.
    max_batch_matches : int
        Bound of the matches in a batch, padding included; bounds memory.
    precision : Precision
        See `choose_precision`; automatically never bfloat16 for a `Rival`, for which it is not measured.
    threads : int
        Pairs pruned at a time on a CPU; 0 for all cores.
    batched : bool, optional
        Run several pairs as one batch; by default on a GPU only. On a CPU each thread takes its own pair:
        padding costs more there than a batch gains, and threads that share a pair wait for each other.
    compile : bool
        Compile the network; pays off on a GPU for many pairs.

    Notes
    -----
    What a pair is batched with, the processor and the number of its threads change a result by rounding
    only. A pair at a time, as by default on a CPU, repeats itself bit by bit on one machine. Otherwise the
    network's neighbours flip where they almost tie: see `corrsfm.model.network`. With the checkpoint
    that was bundled first and read all matches, float32 in five orders of summation against float64 on 90
    validation pairs of 2,000 matches: a neighbour flips in a third of the 450 runs. The score that changes
    most in a pair changes by 1e-5 in the median, by more than 1e-3 in a tenth of the runs, by 0.05 at worst.
    Of 130,865 matches kept at the operating point ``pose`` one changes sides, of 129,860 at ``sfm`` none. An
    untrained network is less steady: scores change by up to 0.3, and kept matches in a tenth of the runs.
    """

    def __init__(
        self,
        network: CorrAdaptor | Rival,
        *,
        checkpoint_sha256: str = "in memory",
        device: str = "auto",
        operating_point: OperatingPoint = PruneConfig.operating_point,
        max_candidates: int = PruneConfig.max_candidates,
        max_batch_matches: int = PruneConfig.max_batch_matches,
        precision: Precision = PruneConfig.precision,
        threads: int = 0,
        batched: bool | None = None,
        compile: bool = False,
    ) -> None:
        self.device = torch.device(find_device(device))
        self.name, channels = "corradaptor", 0
        if isinstance(network, CorrAdaptor):
            channels = network.head.linear1.in_features
        elif network.config is not None:
            self.name = network.config.architecture
        self.dtype = choose_precision(precision, self.device, channels)
        self._num_threads = count_threads(threads)
        self._batched = self.device.type != "cpu" if batched is None else batched
        self.side_channels = network.side_channels
        self.trained_on = network.usage.features
        self._usage = network.usage
        self._min_matches = math.ceil(_MIN_NUM_FOR_MATRIX / network.pruning_ratio**2)
        if self.device.type == "cpu":
            keep_freed_memory()
        self._network: Callable = network.to(self.device).eval()
        if compile:
            self._network = torch.compile(network, dynamic=True)
        self._operating_point = operating_point
        self._max_candidates = max_candidates
        self._max_batch_matches = max_batch_matches
        self._warned = False
        usage = " ".join(f"{name}={value}" for name, value in to_dict(self._usage, only_result=True).items())
        self.fingerprint = (
            f"{self.name}-3 sha256={checkpoint_sha256} operating_point={operating_point} "
            f"max_candidates={max_candidates} dtype={self.dtype} {usage}"
        )

    @classmethod
    def load(
        cls,
        path: Path | str | None = None,
        architecture: str = "corradaptor",
        *,
        device: str = "auto",
        **options: Any,
    ) -> Pruner:
        """A pruner with the network of a checkpoint.

        Parameters
        ----------
        path : Path or str, optional
            Checkpoint in this project's or the published format, or the name of a bundled one; that of the
            architecture for SIFT if not given.
        architecture : str
            The network that it must hold, as for `corrsfm.model.load_network`.
        device : str
            auto, cpu, cuda or cuda:N.
        **options
            As for the class.

        Raises
        ------
        CheckpointError
            If there is no usable checkpoint, or if its network reads side channels that nobody computes.
        """
        network = load_network(path, architecture)
        if network.side_channels not in SIDE_LAYOUTS:
            raise CheckpointError(
                f"{path}: this network reads {network.side_channels} side channels, and corrsfm computes "
                f"{' or '.join(map(str, SIDE_LAYOUTS))}; train one that reads as many"
            )
        sha256 = weights.checkpoint_sha256(path, architecture)
        return cls(network, checkpoint_sha256=sha256, device=device, **options)

    def __call__(self, pairs: Sequence[Correspondences]) -> list[PruneResult]:
        """Prune pairs; see `corrsfm.prune.PrunerProtocol`.

        Scores are the network's probabilities that a match is right, from the last round that judged it;
        see `corrsfm.prune.selection.score_matches` for matches that it did not see, and 0 for those of a kind
        that it does not read. Pairs with fewer than 32 matches to read (for the published pruning ratio) get
        scores but no model.

        Raises
        ------
        InputError
            If the network reads mutual matches and a pair does not say which of its matches are, or reads
            side channels that a pair does not have.
        """
        for pair in pairs:
            missing = missing_channels(
                self.side_channels, has_shapes=pair.shapes_known, has_ratios=pair.scores is None
            )
            if len(pair) and missing:
                raise InputError(f"{pair.name}: this network reads {missing}, which these matches lack")
        candidates = [select_candidates(pair, self._max_candidates, self._usage.input) for pair in pairs]
        self._guard(pairs)
        estimates = self._estimate(pairs, candidates)
        return [
            self._result(pair, len(rows), estimate)
            for pair, rows, estimate in zip(pairs, candidates, estimates, strict=True)
        ]

    def _result(self, pair: Correspondences, num_candidates: int, estimate: NetworkEstimate) -> PruneResult:
        model, residuals = None, np.full(len(pair), np.inf, np.float32)
        if estimate.essential is not None:
            model = TwoViewModel(kind="essential", matrix=estimate.essential)
            residuals = normalised_residuals(model, pair)
        scores = score_matches(estimate.logits, residuals)
        scores[~readable_matches(pair, self._usage.input)] = 0
        return PruneResult(
            scores=scores,
            inlier_mask=select_kept(pair, scores, self._operating_point, self._usage, num_candidates),
            model=model,
            residuals=residuals if model is not None else np.full(len(pair), np.nan, np.float32),
            decided_by=self.name,
        )

    def _estimate(
        self, pairs: Sequence[Correspondences], candidates: Sequence[NDArray[np.intp]]
    ) -> list[NetworkEstimate]:
        """Network outputs of pairs, which run in batches of similar size."""
        estimates = [
            NetworkEstimate(logits=np.full(len(pair), -np.inf, np.float32), essential=None) for pair in pairs
        ]
        todo = [index for index, rows in enumerate(candidates) if len(rows)]
        if not self._batched:
            with _one_thread_an_operation(), ThreadPoolExecutor(self._num_threads) as pool:
                outputs = pool.map(lambda index: next(self._run([(pairs[index], candidates[index])])), todo)
                for index, estimate in zip(todo, outputs, strict=True):
                    estimates[index] = estimate
            return estimates
        for batch in pack_batches([len(candidates[index]) for index in todo], self._max_batch_matches):
            members = [todo[position] for position in batch]
            batch_outputs = self._run([(pairs[index], candidates[index]) for index in members])
            for index, estimate in zip(members, batch_outputs, strict=True):
                estimates[index] = estimate
        return estimates

    def _run(self, items: Sequence[tuple[Correspondences, NDArray[np.intp]]]) -> Iterator[NetworkEstimate]:
        """Run a batch, or its halves when memory runs out."""
        try:
            yield from self._forward(items)
            return
        except RuntimeError as error:
            if not _is_out_of_memory(error):
                raise
            if len(items) == 1:
                pair, rows = items[0]
                raise CorrsfmError(
                    f"{pair.name}: {len(rows)} matches do not fit into the memory of {self.device}; "
                    "try a smaller --max-candidates, or --device cpu"
                ) from error
        if self.device.type == "cuda":
            torch.cuda.empty_cache()
        half = len(items) // 2
        logger.info("out of memory: a batch of %d pairs is halved", len(items))
        yield from self._run(items[:half])
        yield from self._run(items[half:])

    def _forward(self, items: Sequence[tuple[Correspondences, NDArray[np.intp]]]) -> list[NetworkEstimate]:
        longest = max(len(rows) for _, rows in items)
        coordinates = np.zeros((len(items), longest, 4), np.float32)
        side = np.zeros((len(items), longest, self.side_channels), np.float32)
        mask = np.zeros((len(items), longest), bool)
        for index, (pair, rows) in enumerate(items):
            coordinates[index, : len(rows)] = pair.normalised[rows]
            side[index, : len(rows)] = side_information(pair, self.side_channels)[rows]
            mask[index, : len(rows)] = True
        with (
            torch.inference_mode(),
            torch.autocast(self.device.type, torch.bfloat16, enabled=self.dtype is torch.bfloat16),
        ):
            output = self._network(
                torch.from_numpy(coordinates).to(self.device),
                torch.from_numpy(side).to(self.device) if self.side_channels else None,
                None if mask.all() else torch.from_numpy(mask).to(self.device),
            )
            logits = output.last_logits()
        all_logits = logits.cpu().numpy()
        essentials = output.essential.double().cpu().numpy()
        estimates = []
        for index, (pair, rows) in enumerate(items):
            full = np.full(len(pair), -np.inf, np.float32)
            full[rows] = all_logits[index, : len(rows)]
            determined = len(rows) >= self._min_matches
            if not determined and isinstance(output, RivalOutput) and output.residuals_decide:
                full[rows] = -np.inf  # residuals to an arbitrary matrix say nothing
            estimates.append(
                NetworkEstimate(logits=full, essential=essentials[index] if determined else None)
            )
        return estimates

    def _guard(self, pairs: Sequence[Correspondences]) -> None:
        """Warn once if the matches are not the raw nearest neighbours that the network is trained on."""
        if self._warned:
            return
        reads_all = self._usage.input is MatchInput.ALL
        for pair in pairs:
            # Two copies of one photo match perfectly.
            if len(pair) < _GUARD_MIN_MATCHES or np.array_equal(pair.points0, pair.points1):
                continue
            share = float(np.mean(pair.ratios > _GUARD_RATIO))
            if share < _GUARD_MIN_SHARE or (reads_all and pair.mutual.all()):
                self._warned = True
                why = (
                    f"{share:.0%} have a ratio over {_GUARD_RATIO}, {np.mean(pair.mutual):.0%} are mutual"
                    if pair.scores is None
                    else "a matcher or another tool chose them"
                )
                logger.warning(
                    "%s: these matches look filtered already (%s); the network is trained on %s nearest "
                    "neighbours and may do harm here; try --method loransac",
                    pair.name,
                    why,
                    "all" if reads_all else "all mutual",
                )
                return


@contextmanager
def _one_thread_an_operation() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _is_out_of_memory(error: RuntimeError) -> bool:
    # The CPU allocator has no error class of its own.
    return isinstance(error, torch.OutOfMemoryError) or "can't allocate memory" in str(error)
