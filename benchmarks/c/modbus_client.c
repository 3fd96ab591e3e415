/* A libmodbus client that reads 10 holding registers as fast as the server answers.
 *
 *   modbus_client HOST PORT SECONDS      prints requests per second and the median and 99th percentile round trip in us
 */
#include <errno.h>
#include <modbus/modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define MAX_SAMPLES 2000000

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + t.tv_nsec * 1e-9;
}

static int by_value(const void *a, const void *b) {
    float x = *(const float *) a, y = *(const float *) b;
    return (x > y) - (x < y);
}

int main(int argc, char **argv) {
    if (argc != 4) {
        fprintf(stderr, "usage: modbus_client HOST PORT SECONDS\n");
        return 2;
    }
    modbus_t *bus = modbus_new_tcp(argv[1], atoi(argv[2]));
    if (bus == NULL || modbus_set_slave(bus, 1) != 0 || modbus_connect(bus) != 0) {
        fprintf(stderr, "modbus_client: %s\n", modbus_strerror(errno));
        return 1;
    }
    float *samples = malloc(MAX_SAMPLES * sizeof *samples);
    uint16_t registers[10];
    long done = 0;
    double start = now(), end = start + atof(argv[3]), last = start;
    while (last < end && done < MAX_SAMPLES) {
        if (modbus_read_registers(bus, 0, 10, registers) != 10) {
            fprintf(stderr, "modbus_client: %s\n", modbus_strerror(errno));
            return 1;
        }
        double t = now();
        samples[done++] = (float) ((t - last) * 1e6);
        last = t;
    }
    qsort(samples, done, sizeof *samples, by_value);
    printf("%.1f %.1f %.1f\n", done / (last - start), samples[done / 2], samples[done * 99 / 100]);
    modbus_close(bus);
    modbus_free(bus);
    return 0;
}
