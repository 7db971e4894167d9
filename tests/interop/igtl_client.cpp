// Prints what an OpenIGTLink server sends, a message a line; ends after N statuses. Built on Debian's libopenigtlink.
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <igtlClientSocket.h>
#include <igtlMessageHeader.h>
#include <igtlStatusMessage.h>
#include <igtlStringMessage.h>
#include <igtlTimeStamp.h>
#include <igtlTransformMessage.h>

template <class Message> typename Message::Pointer receive(igtl::ClientSocket* socket, igtl::MessageHeader* header) {
  typename Message::Pointer message = Message::New();
  message->SetMessageHeader(header);
  message->AllocatePack();
  socket->Receive(message->GetPackBodyPointer(), message->GetPackBodySize());
  if (!(message->Unpack(1) & igtl::MessageHeader::UNPACK_BODY)) {  // checks the CRC
    std::printf("BROKEN %s\n", header->GetDeviceType());
    std::exit(1);
  }
  return message;
}

int main(int argc, char** argv) {
  int wanted = std::atoi(argv[2]);
  igtl::ClientSocket::Pointer socket = igtl::ClientSocket::New();
  if (socket->ConnectToServer("127.0.0.1", std::atoi(argv[1])) != 0) return 2;
  std::printf("CONNECTED\n");
  std::fflush(stdout);
  for (int statuses = 0; statuses < wanted;) {
    igtl::MessageHeader::Pointer header = igtl::MessageHeader::New();
    header->InitPack();
    if (socket->Receive(header->GetPackPointer(), header->GetPackSize()) != header->GetPackSize()) return 3;
    if (!(header->Unpack(1) & igtl::MessageHeader::UNPACK_HEADER)) return 4;
    igtl::TimeStamp::Pointer time = igtl::TimeStamp::New();
    header->GetTimeStamp(time);
    std::printf("%s %s %.6f ", header->GetDeviceType(), header->GetDeviceName(), time->GetTimeStamp());
    if (!std::strcmp(header->GetDeviceType(), "TRANSFORM")) {
      igtl::Matrix4x4 matrix;
      receive<igtl::TransformMessage>(socket, header)->GetMatrix(matrix);
      for (int row = 0; row < 3; row++)
        for (int column = 0; column < 4; column++) std::printf("%.9g ", matrix[row][column]);
    } else if (!std::strcmp(header->GetDeviceType(), "STATUS")) {
      igtl::StatusMessage::Pointer status = receive<igtl::StatusMessage>(socket, header);
      std::printf("%d %s %s", status->GetCode(), status->GetErrorName(), status->GetStatusString());
      statuses++;
    } else if (!std::strcmp(header->GetDeviceType(), "STRING")) {
      std::printf("%s", receive<igtl::StringMessage>(socket, header)->GetString());
    } else {
      socket->Skip(header->GetBodySizeToRead(), 0);
    }
    std::printf("\n");
    std::fflush(stdout);
  }
  return 0;
}
