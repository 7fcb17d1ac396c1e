"""The program in docs/transmitter.md plays what `encode` wrote: in an emulator of the chip, and on the host."""

import re
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.cli.main import run
from rxcli.link.slots import read_slots
from rxcli.profiles import ScreenProfile, load_profile

PAGE = Path(__file__).parents[2] / "docs" / "transmitter.md"
#: Traces of pins, by simavr's own header.
SECTION = Path("/usr/include/simavr/avr/avr_mcu_section.h")
DATA, CLOCK, LATCH = 1, 2, 4
TRACE = f"""
#include <avr/io.h>
#include "{SECTION}"
AVR_MCU(F_CPU, "atmega328p");
AVR_MCU_VCD_FILE("pins.vcd", 10000000);
const struct avr_mmcu_vcd_trace_t traced[] _MMCU_ = {{
  {{ AVR_MCU_VCD_SYMBOL("data"), .mask = 1, .what = (void*)&PORTB, }},
  {{ AVR_MCU_VCD_SYMBOL("clock"), .mask = 2, .what = (void*)&PORTB, }},
  {{ AVR_MCU_VCD_SYMBOL("latch"), .mask = 4, .what = (void*)&PORTB, }},
}};
"""
#: An ATmega for the host's compiler: every state of the port is printed, sleep is one interrupt.
HOST = """
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
enum { PB0, PB1, PB2, WGM12 = 3, CS10 = 0, OCIE1A = 1 };
static unsigned state, DDRB, TCCR1B, TIMSK1, OCR1A;
static unsigned *port(void) { putchar('0' + state); return &state; }
#define PORTB (*port())
#define PROGMEM
#define pgm_read_byte(place) (*(place))
#define ISR(vector) static void vector(void)
#define sei()
static void TIMER1_COMPA_vect(void);
static void sleep_mode(void) { static unsigned ticks; if (ticks++ == TICKS) exit(0); TIMER1_COMPA_vect(); }
"""


def written(folder: Path, screen: str) -> NDArray[np.uint8]:
    """The slots of one burst, and the program beside them."""
    how = ["encode", "--payload", "random", "--seed", "2", "--screen", screen, "--bursts", "1", "--force", "--out"]
    for name in ("slots.h", "slots.bin"):
        assert run([*how, str(folder / name)]) == 0
    (program,) = re.findall(r"^```c\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    (folder / "player.c").write_text(program)
    return read_slots(folder / "slots.bin", load_profile(screen, ScreenProfile))


def latched(states: Iterable[int]) -> list[list[int]]:
    """Outputs of three registers 74HC595 in a chain, QA of the first one first, whenever they are latched."""
    chain, rows, before = [0] * 24, [], 0
    for state in states:
        if state & ~before & CLOCK:
            chain = [state & DATA, *chain[:-1]]
        if state & ~before & LATCH:
            rows.append(chain[:20])
        before = state
    return rows


def test_the_program_plays_every_slot_on_the_host(tmp_path: Path) -> None:
    if not (compiler := shutil.which("cc") or shutil.which("gcc")):
        pytest.skip("no C compiler here")
    slots = written(tmp_path, "paper-17k3")
    (tmp_path / "avr").mkdir()
    for name in ("interrupt", "io", "pgmspace", "sleep"):
        (tmp_path / "avr" / f"{name}.h").write_text("")
    flags = ["-I.", "-include", "host.h", "-DF_CPU=16000000UL", f"-DTICKS={2 * len(slots)}"]
    (tmp_path / "host.h").write_text(HOST)
    subprocess.run([compiler, *flags, "player.c", "-o", "player"], cwd=tmp_path, check=True)
    states = subprocess.run([tmp_path / "player"], capture_output=True, check=True).stdout
    assert latched(byte - ord("0") for byte in states) == np.tile(slots, (2, 1)).tolist()


@pytest.mark.parametrize("screen", ["paper-17k3", "paper-34k6"])
def test_the_program_plays_every_slot_in_time_in_an_emulator(tmp_path: Path, screen: str) -> None:
    if not (shutil.which("avr-gcc") and shutil.which("simavr") and SECTION.is_file()):
        pytest.skip("no avr-gcc and simavr here")
    slots, rate_hz = written(tmp_path, screen), load_profile(screen, ScreenProfile).slot_rate_hz
    (tmp_path / "trace.c").write_text(TRACE)
    flags = ["-std=c11", "-Wall", "-Werror", "-Os", "-mmcu=atmega328p", "-DF_CPU=16000000UL"]
    subprocess.run(["avr-gcc", *flags, "player.c", "trace.c", "-o", "player.elf"], cwd=tmp_path, check=True)
    with subprocess.Popen(["simavr", "player.elf"], cwd=tmp_path, stdout=subprocess.DEVNULL) as emulator:
        for end in (emulator.terminate, emulator.kill):  # It may wait for itself on its way out.
            try:
                emulator.wait(1)
                break
            except subprocess.TimeoutExpired:
                end()
    state, time, states, latches_s = 0, 0, [], []
    for change in (tmp_path / "pins.vcd").read_text().splitlines():
        if change[:1] == "#" and change[1:].isdigit():
            time = int(change[1:])
        elif len(change) == 2 and change[0] in "01" and change[1] in '!"#':
            pin = 1 << '!"#'.index(change[1])
            if change[0] == "1" and pin == LATCH:
                latches_s.append(1e-8 * time)
            state = state | pin if change[0] == "1" else state & ~pin
            states.append(state)
    n = min(len(slots), len(latches_s) - 2)
    assert n > 300
    assert latched(states)[:n] == slots[:n].tolist()
    number, instant = np.arange(n), np.array(latches_s[:n])
    slope, start = np.polyfit(number, instant, 1)
    assert 1 / slope == pytest.approx(rate_hz, rel=1e-6)
    assert np.abs(instant - (start + slope * number)).max() < 1e-7
