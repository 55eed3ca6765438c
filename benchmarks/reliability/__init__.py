"""The promises of ``docs/reliability.md``, measured; exit code 1 if one is broken."""
