"""Parts of ``splatsoil benchmark speed``."""
