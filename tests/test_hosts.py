"""Two hosts with two processes each, that torchrun lets meet: the bytes of one machine, and how they end if one fails.

Hosts are network namespaces with addresses of their own, between them a cable of 1 Gbit/s; or, far from each other, of
100 Mbit/s and 20 ms, which a thread keeps each packet: few kernels have netem, nearly all have TUN. That needs Linux,
root, the right to make namespaces, and iproute2.
"""

import fcntl
import os
import re
import select
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from collections import deque
from contextlib import contextmanager, suppress

import psutil
import pytest
from commands import ROOT, SCENE, environment_of, python
from test_sharding import GROWTHS, SCHEDULE, train

from warp_splat.errors import InputError
from warp_splat.formats.checkpoint import load_own
from warp_splat.runtime.distributed import ALONE

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="network namespaces need Linux, root"),
    pytest.mark.skipif(not shutil.which("ip") or not shutil.which("tc"), reason="expected ip and tc, of iproute2"),
]
NEAR, FAR = ("1gbit", 0.0), ("100mbit", 0.02)  # rate, and seconds on the way
TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x0001, 0x1000  # of linux/if_tun.h
ENDLESS = f"-s {SCENE} {SCHEDULE} --iterations 1000000 --checkpoint_interval 0.03 --densify_until_iter 0"


def shell(*lines):
    for line in lines:
        subprocess.run(line.split(), check=True, capture_output=True)


def cable_of(number):
    """The device of a host; at most 15 letters."""
    return f"cable{os.getpid()}{number}"


class Host:
    """A namespace with an address, where torchrun starts two processes that know the first host."""

    def __init__(self, number):
        self.number, self.name, self.cable = number, f"splat{os.getpid()}{number}", cable_of(number)

    def connect(self, rate):
        name, cable = self.name, self.cable
        shell(
            f"ip link set {cable} netns {name}",
            f"ip -n {name} link set lo up",
            *(f"ip -n {name} addr add 10.77.0.{self.number}/24 dev {cable}", f"ip -n {name} link set {cable} up"),
            f"ip netns exec {name} tc qdisc add dev {cable} root tbf rate {rate} burst 256k latency 50ms",
        )

    def start(self, folder, options, *torchrun, before=()):
        """The agent of torchrun; what it and its processes say goes into a file."""
        words = ["ip", "netns", "exec", self.name, *before, sys.executable, "-m", "torch.distributed.run", *torchrun]
        words += ["--nnodes", "2", "--nproc-per-node", "2", "--local-addr", f"10.77.0.{self.number}"]
        words += ["--rdzv-conf", f"is_host={self.number == 1}"]  # its name is that of both
        words += ["--rdzv-backend", "c10d", "--rdzv-endpoint", "10.77.0.1:29400", str(ROOT / "train.py"), "--shard"]
        environment = environment_of(GLOO_SOCKET_IFNAME=self.cable)
        self.log = folder.with_name(f"host{self.number}.txt")
        with self.log.open("w") as log:
            pipes = {"stdout": log, "stderr": log, "env": environment}
            self.agent = psutil.Popen([*words, "-m", str(folder), *options.split()], **pipes)

    def processes(self):
        """Those that train; an agent that waits for a network does not take notice of their ends."""
        return [child for child in self.agent.children() if trains(child)]

    def end(self):
        if hasattr(self, "agent") and self.agent.is_running():
            for process in [*self.processes(), self.agent]:
                process.kill()
            self.agent.wait(10)


def trains(process):
    try:
        return process.status() != psutil.STATUS_ZOMBIE and "RANK" in process.environ()
    except (psutil.NoSuchProcess, ProcessLookupError):  # it has ended a moment ago
        return False


@contextmanager
def cable(delay):
    """Two devices: what one sends, the other receives ``delay`` seconds later."""
    if not delay:
        shell(f"ip link add {cable_of(1)} type veth peer name {cable_of(2)}")
        yield
        return
    ends, ended = [os.open("/dev/net/tun", os.O_RDWR) for _ in range(2)], threading.Event()
    for number, end in enumerate(ends, 1):
        fcntl.ioctl(end, TUNSETIFF, struct.pack("16sH22x", cable_of(number).encode(), IFF_TUN | IFF_NO_PI))
    threads = [threading.Thread(target=carry, args=(*pair, delay, ended)) for pair in (ends, ends[::-1])]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        for thread in threads:
            thread.join()
        for end in ends:
            os.close(end)


def carry(source, target, delay, ended):
    waiting = deque()
    while not ended.is_set():
        if select.select([source], [], [], max(waiting[0][0] - time.monotonic(), 0.0) if waiting else 0.1)[0]:
            with suppress(OSError):  # the host has gone
                waiting.append((time.monotonic() + delay, os.read(source, 65536)))
        while waiting and waiting[0][0] <= time.monotonic():
            with suppress(OSError):
                os.write(target, waiting.popleft()[1])


@pytest.fixture
def hosts(request):
    pair = [Host(1), Host(2)]
    rate, delay = getattr(request, "param", NEAR)
    if delay and not os.path.exists("/dev/net/tun"):
        pytest.skip("expected /dev/net/tun")
    one, other = (host.name for host in pair)
    try:
        try:
            shell(f"ip netns add {one}", f"ip netns add {other}")
        except subprocess.CalledProcessError as error:
            pytest.skip(f"expected the right to make network namespaces ({error.stderr.decode().strip()})")
        with cable(delay):
            for host in pair:
                host.connect(rate)
            yield pair
    finally:
        for host in pair:
            host.end()
            subprocess.run(["ip", "netns", "del", host.name], check=False, capture_output=True)


@pytest.mark.parametrize("hosts", [NEAR, FAR], indirect=True, ids=["near", "far"])
def test_two_hosts_make_the_model_of_one_machine(hosts, tmp_path):
    """Also where packets are lost on the way."""
    if shutil.which("nft"):
        rule = "add table inet f; add chain inet f i { type filter hook input priority 0; }; "
        rule += "add rule inet f i numgen random mod 100 < 2 drop"
        subprocess.run(["ip", "netns", "exec", hosts[0].name, "nft", rule], check=True)
    options = f"-s {SCENE} {SCHEDULE} --iterations 80 {GROWTHS['budget']}"
    for host in hosts:
        host.start(tmp_path / "hosts", options)
    assert [host.agent.wait(500) for host in hosts] == [0, 0], hosts[0].log.read_text()
    (model,) = (tmp_path / "hosts").glob("point_cloud/*/point_cloud.ply")
    assert model.read_bytes() == train(tmp_path / "one", 1, options)


def signaled(which, *signals):
    """Let the agent and the processes of the second host, or only its last process, get a signal."""

    def do(hosts):
        found = [*hosts[1].processes(), hosts[1].agent]
        for process in found if which == "host" else found[1:2] if which == "process" else found[-1:]:
            process.send_signal(*signals)

    return do


FAILURES = {
    "dies": (signaled("host", signal.SIGKILL), r"no sign of process [23]"),
    "hangs": (signaled("host", signal.SIGSTOP), r"no sign of process 2, 3"),
    "one process hangs": (signaled("process", signal.SIGSTOP), r"no sign of process 3"),
    "is cut off": (lambda hosts: shell(f"ip -n {hosts[1].name} link set {hosts[1].cable} down"), r"process 2, 3"),
    "Ctrl-C": (signaled("agent", signal.SIGINT), r"To continue after iteration"),
}


@pytest.mark.parametrize(
    ("failure", "hosts"),
    [*((failure, NEAR) for failure in FAILURES), ("dies", FAR), ("hangs", FAR)],
    indirect=["hosts"],
    ids=[*FAILURES, "dies far away", "hangs far away"],
)
def test_when_a_host_fails_all_end_and_fewer_go_on(failure, hosts, tmp_path):
    fail, said = FAILURES[failure]
    begin(hosts, tmp_path / "hosts")
    fail(hosts)
    ending = hosts[:1] if failure in ("dies", "hangs") else hosts  # a second host that can
    begun = time.monotonic()
    for host in ending:
        until(lambda host=host: not host.processes(), 100, hosts)
        print(f"{failure}: no process on host {host.number} after {time.monotonic() - begun:.1f} s")
    found = hosts[0].log.read_text()
    assert re.search(said, found), found
    for host in hosts:
        host.end()
    goes_on(tmp_path / "hosts")


def test_all_that_stand_still_for_a_while_go_on(hosts, tmp_path):
    """As after Ctrl-Z and fg: none takes the others for hung."""
    begin(hosts, tmp_path / "hosts")
    for sent in (signal.SIGSTOP, signal.SIGCONT):
        for process in [process for host in hosts for process in host.processes()]:
            process.send_signal(sent)
        time.sleep(25)
    before = iteration(tmp_path / "hosts")
    until(lambda: iteration(tmp_path / "hosts") > before, 150, hosts)


def test_a_full_disk_on_one_host_costs_a_checkpoint(hosts, tmp_path):
    """Those with moments of harmonics, from iteration 30 on, do not fit: training goes on, and the one before stays."""
    hosts[0].start(tmp_path / "hosts", ENDLESS)
    hosts[1].start(tmp_path / "hosts", ENDLESS, before=["prlimit", "--fsize=500000"])
    until(lambda: "process 2 could not write its block" in hosts[0].log.read_text(), 150, hosts)
    assert 0 <= iteration(tmp_path / "hosts") < 30
    assert all(process.is_running() for host in hosts for process in host.processes())
    for host in hosts:
        host.end()
    goes_on(tmp_path / "hosts")


def test_torchrun_restarts_from_the_last_checkpoint(hosts, tmp_path, monkeypatch):
    """With a new store for each start: one that stays has the addresses of processes that have gone."""
    monkeypatch.setenv("TORCH_DISABLE_SHARE_RDZV_TCP_STORE", "1")
    begin(hosts, tmp_path / "hosts", "--max-restarts", "1")
    hosts[1].processes()[0].kill()
    until(lambda: "Continuing after" in hosts[0].log.read_text(), 150, hosts)
    before = iteration(tmp_path / "hosts")
    until(lambda: iteration(tmp_path / "hosts") > before, 150, hosts)


def test_a_host_that_comes_back_goes_on(hosts, tmp_path, monkeypatch):
    """torchrun of the first one starts its processes again, and waits; the second one is started with --resume."""
    monkeypatch.setenv("TORCH_DISABLE_SHARE_RDZV_TCP_STORE", "1")
    begin(hosts, tmp_path / "hosts", "--max-restarts", "1")
    signaled("host", signal.SIGKILL)(hosts)
    hosts[1].agent.wait(10)
    hosts[1].start(tmp_path / "hosts", f"--resume {tmp_path / 'hosts'}", "--max-restarts", "1")
    until(lambda: "Continuing after" in hosts[0].log.read_text(), 150, hosts)
    before = iteration(tmp_path / "hosts")
    until(lambda: iteration(tmp_path / "hosts") > before, 150, hosts)


def begin(hosts, folder, *torchrun):
    """Start an endless training on all, and wait for its first checkpoint after some steps."""
    for host in hosts:
        host.start(folder, ENDLESS, *torchrun)
    until(lambda: iteration(folder) > 0, 150, hosts)


def iteration(folder):
    """Of the last checkpoint; -1 if there is none, or it is being replaced."""
    try:
        return load_own(folder, ALONE).facts["iteration"]
    except InputError:
        return -1


def until(true, seconds, hosts):
    deadline = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < deadline, [host.log.read_text() for host in hosts]
        time.sleep(0.3)


def goes_on(folder):
    """One process resumes what four have left."""
    end = load_own(folder, ALONE).facts["iteration"] + 8
    assert "Done after" in python(ROOT / "train.py", "--resume", folder, "--no-shard", "--iterations", end).stdout
