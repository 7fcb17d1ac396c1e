"""What every capture gives, in one table: right packets, sure ones and wrong ones.

python tests/corpus.py            # measure the captures and raise their floors
python tests/corpus.py NAME...    # of these captures also lower them: the commit says why
"""

import sys
import tomllib
from collections.abc import Iterator
from dataclasses import asdict, astuple, dataclass, replace
from functools import cache
from itertools import islice
from pathlib import Path

from rxcli.ingest import open_source
from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.receiver.receive import receive
from rxcli.resources import data_dir
from rxcli.results.truth import Scorer, load_truth, truth_path
from rxcli.types import FrameResult

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent))
from small_scene import camera_of

TABLE = Path(__file__).resolve().with_suffix(".toml")
#: Folders of the captures: the project's own, and those beside the checkout, where there are any.
PLACES = {"sample_frames": data_dir("sample_frames"), "captures": TABLE.parents[2] / "shared" / "captures"}
#: Share of the packets, and packets, by which another machine may give more or less.
_NOISE, _MIN_NOISE = 0.01, 1


@dataclass(frozen=True)
class Counts:
    """Packets of a capture."""

    #: Without a wrong bit; of a confidence of 0.99 and more; with a wrong bit; and surely so.
    right: int
    sure: int
    wrong: int
    surely_wrong: int

    @property
    def noise(self) -> int:
        """Packets that another machine may give more or less."""
        return max(round(_NOISE * self.right), _MIN_NOISE)

    def faults(self, floor: "Counts") -> Iterator[str]:
        """Counts that are worse than a floor, or better by more than noise."""
        for name, count, least in zip(asdict(self), astuple(self), astuple(floor), strict=True):
            better = count - least if name in ("right", "sure") else least - count
            if better < 0:
                yield f"{name}: {count}, the floor is {least}"
            elif better > floor.noise:
                yield f"{name}: {count} is better than the floor of {least}: raise it with `python tests/corpus.py`"

    def raised(self, floor: "Counts") -> "Counts":
        """The floor, raised to these counts where they are better."""
        return Counts(
            max(self.right, floor.right),
            max(self.sure, floor.sure),
            min(self.wrong, floor.wrong),
            min(self.surely_wrong, floor.surely_wrong),
        )


def floors() -> dict[str, Counts]:
    """The table."""
    return {name: Counts(*row) for name, row in tomllib.loads(TABLE.read_text(encoding="utf-8")).items()}


def path_of(name: str) -> Path:
    """The file of a row of the table."""
    place, file = name.split()[0].split("/")
    return PLACES[place] / file


@cache
def received(name: str) -> tuple[FrameResult, ...]:
    """The results of a row of the table, with the wrong bits of every packet."""
    path, (_, *how) = path_of(name), name.split()
    truth, options = load_truth(truth_path(path)), ReceiverOptions()
    if "known" in how:
        screen = load_profile(str(truth.screen), ScreenProfile)
        options = replace(options, screens=(screen,), cameras=(camera_of(truth.camera),), force_camera=True)
    n_frames = next((int(word) for word in how if word.isdigit()), None)
    scorer = Scorer(truth)
    return tuple(scorer.add(result) for result in receive(islice(open_source(path), n_frames), options))


def counts_of(results: tuple[FrameResult, ...]) -> Counts:
    """Packets of some results."""
    packets = [packet for result in results for packet in result.packets]
    sure = [packet for packet in packets if packet.confidence >= 0.99]
    right, surely_right = (sum(packet.bit_errors == 0 for packet in some) for some in (packets, sure))
    return Counts(right, len(sure), len(packets) - right, len(sure) - surely_right)


def main(lowered: list[str]) -> None:
    """Measure all captures and write the table."""
    rows = []
    for name, floor in floors().items():
        counts = counts_of(received(name)) if path_of(name).is_file() else floor
        new = counts if name in lowered or name.split()[0] in lowered else counts.raised(floor)
        print(f"{name}: {astuple(counts)}, floor {astuple(floor)}{' not raised' * (counts != new)}", flush=True)
        rows.append(f'"{name}" = {list(astuple(new))}')
    head = [line for line in TABLE.read_text(encoding="utf-8").splitlines() if line.startswith("#")]
    TABLE.write_text("\n".join([*head, *rows, ""]), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
