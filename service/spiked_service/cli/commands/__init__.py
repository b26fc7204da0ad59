"""The commands of `spiked`, one per file; `cli.command_table` lists them."""
