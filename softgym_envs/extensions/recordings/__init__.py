"""Episodes as files of other programs: glTF, ParaView, Minari."""
