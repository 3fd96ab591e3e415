/* libmodbus's own server, as its examples write it: one client after another, 100 holding registers.
 *
 *   modbus_server PORT
 */
#include <errno.h>
#include <modbus/modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>

int main(int argc, char **argv) {
    if (argc != 2) {
        fprintf(stderr, "usage: modbus_server PORT\n");
        return 2;
    }
    modbus_t *bus = modbus_new_tcp("127.0.0.1", atoi(argv[1]));
    modbus_mapping_t *map = modbus_mapping_new(0, 0, 100, 0);
    int listening = bus == NULL ? -1 : modbus_tcp_listen(bus, 1);
    if (listening < 0 || map == NULL) {
        fprintf(stderr, "modbus_server: %s\n", modbus_strerror(errno));
        return 1;
    }
    puts("ready");
    fflush(stdout);
    for (;;) {
        uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
        if (modbus_tcp_accept(bus, &listening) < 0)
            return 1;
        int length;
        while ((length = modbus_receive(bus, query)) != -1)
            if (length > 0)
                modbus_reply(bus, query, length, map);
        modbus_close(bus);
    }
}
