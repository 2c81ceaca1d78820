"""Files: designs as TOML or JSON, and measured records."""
