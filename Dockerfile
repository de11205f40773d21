# CPU only. docker build -t splatsoil . ; docker run --rm -v "$PWD":/work splatsoil run examples/plow-dry
FROM python:3.11-slim
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY splatsoil splatsoil
COPY envs envs
COPY inverse inverse
COPY benchmarks benchmarks
RUN pip install --no-cache-dir torch --index-url https://download.pytorch.org/whl/cpu \
    && pip install --no-cache-dir '.[export,tags,video]'
WORKDIR /work
ENTRYPOINT ["splatsoil"]
