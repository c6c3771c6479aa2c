// libnvrtc on a CPU, for tests: g++ compiles the source, included by emulate.cpp, to a library. GPUs from 75 to 90.
#include <unistd.h>

#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <iterator>
#include <string>

typedef int Result;
enum { SUCCESS = 0, INVALID_OPTION = 5, COMPILATION = 6 };
static const int ARCHITECTURES[] = {75, 80, 86, 90};

struct Program { std::string source, log, binary; bool ptx; };

static std::string read(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    return std::string(std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>());
}

static std::string setting(const char* name) { const char* value = std::getenv(name); return value ? value : ""; }

extern "C" {

Result nvrtcVersion(int* major, int* minor) { *major = 12; *minor = 9; return SUCCESS; }
Result nvrtcGetNumSupportedArchs(int* count) { *count = 4; return SUCCESS; }
Result nvrtcGetSupportedArchs(int* numbers) { std::memcpy(numbers, ARCHITECTURES, sizeof ARCHITECTURES); return SUCCESS; }
const char* nvrtcGetErrorString(int code) { return code == COMPILATION ? "NVRTC_ERROR_COMPILATION" : "NVRTC_ERROR"; }

Result nvrtcCreateProgram(Program** program, const char* source, const char*, int headers, const char**, const char**) {
    if (headers) return INVALID_OPTION;
    *program = new Program{source, "", "", false};
    return SUCCESS;
}

Result nvrtcDestroyProgram(Program** program) { delete *program; *program = nullptr; return SUCCESS; }

Result nvrtcCompileProgram(Program* program, int count, const char** options) {
    std::string macros;
    for (int i = 0; i < count; ++i) {
        const std::string option = options[i];
        if (option.compare(0, 2, "-D") == 0) macros += " '" + option + "'";
        else if (option.compare(0, 27, "--gpu-architecture=compute_") == 0) program->ptx = true;
        else if (option.compare(0, 2, "--") != 0) return INVALID_OPTION;
    }
    char folder[] = "/tmp/legs-nvrtc-XXXXXX";
    if (!mkdtemp(folder)) return COMPILATION;
    const std::string at = folder, text = at + "/legs.cu", library = at + "/legs.so", log = at + "/log";
    std::ofstream(text, std::ios::binary) << program->source;
    const std::string command = setting("LEGS_EMULATION_COMMAND") + macros + " '-DSOURCE=\"" + text + "\"' -o " + library + " 2> " + log;
    const int status = std::system(command.c_str());
    program->log = read(log);
    program->binary = (program->ptx ? ".version 8.8\n" : "") + read(library);
    for (const std::string& path : {text, library, log}) unlink(path.c_str());
    rmdir(folder);
    return status == 0 ? SUCCESS : COMPILATION;
}

static Result size(const std::string& text, size_t* size) { *size = text.size(); return SUCCESS; }
static Result copy(const std::string& text, char* to) { std::memcpy(to, text.data(), text.size()); return SUCCESS; }

Result nvrtcGetProgramLogSize(Program* program, size_t* bytes) { *bytes = program->log.size() + 1; return SUCCESS; }
Result nvrtcGetProgramLog(Program* program, char* to) { std::strcpy(to, program->log.c_str()); return SUCCESS; }
Result nvrtcGetCUBINSize(Program* program, size_t* bytes) { return size(program->binary, bytes); }
Result nvrtcGetCUBIN(Program* program, char* to) { return copy(program->binary, to); }
Result nvrtcGetPTXSize(Program* program, size_t* bytes) { return size(program->binary, bytes); }
Result nvrtcGetPTX(Program* program, char* to) { return copy(program->binary, to); }
}
