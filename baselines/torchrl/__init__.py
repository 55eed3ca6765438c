"""MAPPO and IPPO with TorchRL on the decentralised form."""
