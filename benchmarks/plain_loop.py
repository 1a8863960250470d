"""The plain way: one `recv_into` a packet. `python -m benchmarks.plain_loop HOST_ADDRESS PORT BUFFER_BYTES`.

Counts packets, nothing else: no placement, no file. Reads lines `PACKETS`, and answers with one line of JSON when that
many came, or none for a second.
"""

from __future__ import annotations

import json
import sys
import time

from polysight.capture.network import bind_udp, enlarge_receive_buffer, kernel_drops


def main(argv: list[str]) -> int:
    """Serve until the standard input ends."""
    sock = bind_udp(argv[1], int(argv[2]), "plain loop")
    enlarge_receive_buffer(sock, int(argv[3]))
    sock.settimeout(1.0)
    room = memoryview(bytearray(2048))
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    for line in sys.stdin:
        wanted, got, drops, cpu = int(line), 0, kernel_drops(sock), time.process_time()
        idle = 0
        while got < wanted and idle < 3:
            try:
                sock.recv_into(room)
            except TimeoutError:
                idle += 1
                continue
            got += 1
        answer = {"received": got, "drops": kernel_drops(sock) - drops, "cpu_s": time.process_time() - cpu}
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv))
