"""Everything that is looked at: the recording, its layout, and figures. Only here are rerun and matplotlib used."""
