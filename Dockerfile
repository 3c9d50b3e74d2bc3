# The program in a small image: docker build -t snapsnap . && docker run --rm -v "$PWD:/photographs" snapsnap reconstruct front.jpg back.jpg
FROM rust:1.95-bookworm AS build
WORKDIR /snapsnap
COPY . .
RUN cargo build --locked --profile dist --package snapsnap --bin snapsnap

FROM debian:bookworm-slim
COPY --from=build /snapsnap/target/dist/snapsnap /usr/local/bin/snapsnap
WORKDIR /photographs
ENTRYPOINT ["snapsnap"]
CMD ["--help"]
