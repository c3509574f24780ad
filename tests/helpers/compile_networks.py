"""Compile depth networks to one graph each and compare with eager: ``python compile_networks.py BACKEND NAME...``.

A program of its own, because the compiler cannot look into the type checker that tests run under. A name is an encoder
and a decoder, and for ``aunet`` an attention: ``resnet18+unet``, ``stratified_nano+aunet+se``.
"""

from __future__ import annotations

import sys

import torch

from saunet.models.depth import DepthNet
from saunet.registry import decoders, encoders


def main() -> None:
    backend, *names = sys.argv[1:]
    for name in names:
        torch.manual_seed(0)
        encoder, decoder, *attention = name.split("+")
        chosen = {"attention": attention[0]} if attention else {}
        net = DepthNet(encoders.build(encoder), decoders.partial(decoder, **chosen)).eval()
        image = torch.rand(1, 3, 64, 96)
        torch.compiler.reset()
        with torch.no_grad():
            compiled = torch.compile(net, fullgraph=True, backend=backend)(image)
            torch.testing.assert_close(compiled.disparity, net(image).disparity, rtol=1e-3, atol=1e-4)
        print(name, flush=True)


if __name__ == "__main__":
    main()
