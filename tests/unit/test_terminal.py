"""What a command prints and returns, whatever its streams are like and however it ends; in processes of its own."""

import os
import signal
import subprocess
import sys
import textwrap
import time

import pytest

from hm_sfm.cli.terminal import stop_on_terminate


def start(body: str, *arguments: str, **settings) -> subprocess.Popen[str]:
    """Start `hm-sfm demo OUT` with another body, given as the lines of a function of its options."""
    code = "import logging, os, signal, sys, time\nfrom tqdm import tqdm\nfrom hm_sfm.cli import commands, main\n"
    # A shell that starts the tests in the background has processes ignore Ctrl-C.
    code += "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    code += "from hm_sfm.errors import InputError\n"
    code += f"def run_demo(options):\n{textwrap.indent(textwrap.dedent(body), '    ')}\n"
    code += "commands.run_demo = run_demo\nsys.exit(main(sys.argv[1:]))\n"
    settings = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, **settings}
    return subprocess.Popen([sys.executable, "-c", code, "demo", *(arguments or ["out"])], **settings)


def finish(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=60)
    return process.returncode, out, err


def show_lines(text: str) -> list[str]:
    """The lines as a terminal shows them: a carriage return goes back to the start of a line."""
    lines = []
    for line in text.split("\n"):
        shown = ""
        for part in line.split("\r"):
            shown = part + shown[len(part) :]
        lines.append(shown.rstrip())
    return lines


def test_closed_streams_change_nothing(tmp_path):
    """With 2>&-, the next file that is opened must not be the one that libraries print to."""
    body = """
    with open(options.out, "w") as file:
        assert file.fileno() > 2
        os.write(2, b"a library complains")
        print("done"); print("a warning", file=sys.stderr); logging.warning("a warning")
        for _ in tqdm(range(3)): pass
        file.write("data")
    raise InputError("a fault")
    """
    for closed in ("2>&-", ">&- 2>&-", "<&- >&- 2>&-"):
        process = start(body, str(tmp_path / "file"), preexec_fn=lambda closed=closed: close_streams(closed))
        assert finish(process)[0] == 2
        assert (tmp_path / "file").read_text() == "data"


def close_streams(redirections: str) -> None:
    for redirection in redirections.split():
        os.close({"<&-": 0, ">&-": 1, "2>&-": 2}[redirection])


def test_characters_that_a_stream_lacks_are_escaped(tmp_path):
    body = """
    print(f"photos: {options.out}")
    logging.warning("skipped: %s", options.out)
    raise InputError(f"no photo in {options.out}")
    """
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    name = "f\N{LATIN SMALL LETTER E WITH ACUTE}te \N{CJK UNIFIED IDEOGRAPH-5199}"
    code, out, err = finish(start(body, name, env=environment))
    escaped = r"f\xe9te \u5199"
    assert (code, out) == (2, f"photos: {escaped}\n")
    assert err == f"WARNING: skipped: {escaped}\nhm-sfm: no photo in {escaped}\n"


@pytest.mark.parametrize(
    ("number", "code", "word"), [(signal.SIGTERM, 143, "terminated"), (signal.SIGINT, 130, "interrupted")]
)
def test_signals_end_a_command_in_one_line_and_clean_up(tmp_path, number, code, word):
    body = """
    try:
        for _ in tqdm(range(10)):
            open(options.out, "w").close()
            time.sleep(30)
    finally:
        os.remove(options.out)
    """
    process = start(body, str(tmp_path / "temporary"))
    while not (tmp_path / "temporary").exists():
        time.sleep(0.02)
    process.send_signal(number)
    returned, _, err = finish(process)
    assert returned == code and not (tmp_path / "temporary").exists()
    assert show_lines(err)[-2:] == [f"hm-sfm: {word}; run the same command again to continue", ""]
    assert "Traceback" not in err


def test_a_forked_worker_that_is_terminated_says_nothing():
    body = """
    import multiprocessing
    worker = multiprocessing.get_context("fork").Process(target=time.sleep, args=(30,))
    worker.start()
    time.sleep(0.5)  # Python forgets signals that come while it forks
    worker.terminate()
    worker.join()
    print(worker.exitcode)
    return 0
    """
    assert finish(start(body)) == (0, f"{-signal.SIGTERM}\n", "")


def test_progress_bars_hide_nothing():
    body = """
    for number in tqdm(range(3), desc="first"):
        logging.warning("skipped: photo %d", number)
    for number in tqdm(range(3), desc="second"):
        if number == 1:
            raise InputError("a.jpg is\\n damaged")
    """
    code, _, err = finish(start(body))
    lines = show_lines(err)
    assert code == 2
    assert [line for line in lines if "skipped" in line] == [f"WARNING: skipped: photo {n}" for n in range(3)]
    assert lines[-3].startswith("second:  33%") and lines[-2:] == ["hm-sfm: a.jpg is damaged", ""]


def test_warnings_of_libraries_to_programmers_are_not_shown():
    body = """
    import warnings
    warnings.warn("this will change")
    return 0
    """
    assert finish(start(body)) == (0, "", "")


def test_a_reader_that_leaves_early_is_no_fault():
    body = """
    for _ in range(10000):
        print("a line")
    return 0
    """
    process = start(body)
    assert process.stdout.readline() == "a line\n"
    process.stdout.close()
    process.stdout = None
    assert process.wait(60) == 141 and process.stderr.read() == ""


def test_the_handler_of_signals_is_restored():
    before = signal.getsignal(signal.SIGTERM)
    with stop_on_terminate():
        assert signal.getsignal(signal.SIGTERM) != before
    assert signal.getsignal(signal.SIGTERM) == before
