import subprocess
import sys

import torch

from hm_sfm.network.device import computes_in_half

ASK = "import torch; from hm_sfm.network.device import computes_in_half as ask; print(ask(torch.device('cpu')))"


def test_a_processor_that_is_limited_to_avx2_does_not_compute_in_half(monkeypatch):
    monkeypatch.setenv("ATEN_CPU_CAPABILITY", "avx2")
    assert subprocess.check_output([sys.executable, "-c", ASK], text=True).strip() == "False"


def test_half_precision_needs_matrix_units_and_pytorch_s_use_of_them(monkeypatch):
    for supported in (False, True):
        for capability in ("AVX2", "AVX512"):
            monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda supported=supported: supported)
            monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda capability=capability: capability)
            assert computes_in_half(torch.device("cpu")) == (supported and capability == "AVX512")
    assert computes_in_half(torch.device("cuda"))
